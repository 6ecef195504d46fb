"""Open-loop jumps (squat, hold, full extension): the apex height that each robot of an environment can reach."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jumper_warp.evaluation.jump_metrics import HEIGHT_METRICS
from jumper_warp.evaluation.jumps import TOLERANCE, JumpOutcome, jump_commands
from jumper_warp.sim.apex import HOLD, LEVELS, RAMP, STAND
from jumper_warp.utils.files import Json
from jumper_warp.utils.metrics import Metrics, chosen, mean, measure, rate
from jumper_warp.utils.progress import phase

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env

PUSH_PROBABILITY = "events.push.probability"


def open_loop_limits(env: Env, initial_state: Json) -> np.ndarray:
    """Simulate the open-loop jump of each robot; return the largest base heights [m], (num_envs,), NaN if diverged.

    The robots have the parameters that their first `evaluation_reset` samples, latency included, but no pushes.

    env: environment of a jump task with squat at action 1 and full extension at -1; it stays at the end of the jump.
    initial_state: `env.state_dict()` before its first `evaluation_reset`.
    """
    import torch

    env.load_state_dict(initial_state)
    params = env.skills[0].task.params
    if PUSH_PROBABILITY in params.names:
        env.set(PUSH_PROBABILITY, 0.0)
    env.evaluation_reset(jump_commands(np.zeros((env.num_envs, 3)), 0.0, env.step_dt))
    apex = np.zeros(env.num_envs)
    diverged = np.zeros(env.num_envs, dtype=bool)
    with phase(f"simulating {env.num_envs} open-loop jumps", len(LEVELS)) as advance:
        for step, level in enumerate(LEVELS.tolist()):
            env.step(torch.tensor([0.0, level, level] * 4, device=env.device).repeat(env.num_envs, 1))
            arrays = env.task_arrays()
            diverged |= env.episodes.diverged.numpy() != 0
            if step >= STAND + RAMP + HOLD:
                apex = np.fmax(apex, arrays["base_pos"][:, 2])
            advance()
    if PUSH_PROBABILITY in params.names:
        env.set(PUSH_PROBABILITY, params.values[params.names[PUSH_PROBABILITY]])
    return np.where(diverged, np.nan, apex)


def limit_metrics(outcome: JumpOutcome, target: np.ndarray, limit: np.ndarray, inside: np.ndarray) -> Metrics:
    """Return metrics of jumps to heights, by whether the robot's open-loop jump reaches that height.

    A height is reachable if it is at most TOLERANCE above the open-loop apex.
    limit [m]: open-loop apex of the same robots, (num_envs, 1). `open_loop_apex_error_abs_mean_m` is the error of ideal
    jumps that cannot exceed the limit. target [m], inside: commanded heights and mask of those in range.
    """
    reachable, note = target <= limit + TOLERANCE, "to reachable heights"
    rates = chosen(HEIGHT_METRICS, "goal_reached_rate", "success_rate")
    error = chosen(HEIGHT_METRICS, "apex_error_abs_mean_m")
    return {
        "open_loop_apex_mean_m": mean(limit, "robots"),
        "open_loop_apex_error_abs_mean_m": mean(np.maximum(target - limit, 0.0), "jumps"),
        "reachable_rate": rate(reachable, "jumps"),
        **measure(rates, outcome, reachable, "reachable_", note),
        **measure(rates[:1], outcome, ~reachable, "unreachable_", "to other heights"),
        **measure(rates, outcome, reachable & inside, "reachable_in_range_", f"{note} in range"),
        **measure(error, outcome, target <= limit, "up_to_limit_", "up to the open-loop apex"),
    }

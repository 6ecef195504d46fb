"""Measure how still a policy waits for its command, and write metrics and a recording.

    python experiments/squat_hold.py --policy vertical_jump --hold-time 30 --out outputs/hold
    python experiments/squat_hold.py --policy horizontal_jump --num-squats 500 --randomize

Robots get a goal but no command. Three metrics cover the last second: the range of the force on each paw (largest value
over physics steps minus smallest over policy steps), the fraction of the time for which a paw is lifted, and the ripple
of the motor torques. Randomised robots have observation noise and are pushed by up to 10 N.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.jumps import jump_commands
from jumper_warp.evaluation.log import EvaluationLog
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.tasks.jump.evaluation import JumpEvaluation
from jumper_warp.utils.metrics import Metrics, largest, mean, rate
from support.scripts import run_script

CONTACT_FORCE = 0.1  # [N] Smallest force on a paw that is on the ground
WINDOW = 60  # Policy steps at the end over which forces and torques are evaluated
SUMMARY = ("holding_rate", "paw_force_range_mean_n", "lost_paw_share_mean", "torque_ripple_mean_nm", "drift_mean_m")


@dataclass
class SquatLog(EvaluationLog):
    """Log of robots that wait, one per world; those whose episodes end are left out of all metrics but the rate."""

    goals: np.ndarray  # [m] (num_envs, 3) Goals of the jumps: x, y relative to start and heading, and apex height z
    seconds: float = 3.0  # [s] Simulated time, within which the jump is not commanded
    steps: list[dict[str, np.ndarray]] = field(default_factory=list, init=False)
    """Arrays by name per policy step: largest force on each paw over its physics steps `peak` and force at its end
    `force` [N], (num_envs, 4), `torque` [N m], (num_envs, 12), and `position` of the base [m], (num_envs, 2)."""
    row_name = "squat"

    def __post_init__(self) -> None:
        """Prepare the flags of ended episodes."""
        self.count = len(self.goals)
        self.ended = np.zeros(self.count, dtype=bool)

    def begin(self, env: Env) -> None:
        """Reset every robot to the default pose, with a goal whose jump would be commanded after the end."""
        env.evaluation_reset(jump_commands(self.goals, self.seconds + 1.0, env.step_dt))

    def read_env(self, env: Env) -> dict[str, np.ndarray]:
        """Return the arrays of a policy step, and the termination of each robot, (num_envs,), for `update`."""
        return {
            "peak": env.sim.peak_paw_force.numpy().T.copy(),
            "force": np.linalg.norm(env.sim.paw_force.numpy(), axis=2).T.copy(),
            "torque": env.sim.torque.numpy().T.copy(),
            "position": env.sim.joint_q()[:, :2].copy(),
            "termination": env.episodes.termination.numpy().copy(),
        }

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Record a policy step from the arrays of `read_env`; return whether all episodes have ended."""
        self.ended |= arrays["termination"] >= 0
        self.steps.append(arrays)
        return bool(self.ended.all())

    def metrics(self) -> Metrics:
        """Return the metrics by name; forces, torques and drift are of the robots that hold to the end."""
        last = {name: np.array([step[name] for step in self.steps[-WINDOW:]])[:, ~self.ended] for name in self.steps[0]}
        spread = (last["peak"].max(axis=0) - last["force"].min(axis=0)).max(axis=1)
        ripple = np.sqrt(last["torque"].var(axis=0).mean(axis=1))
        drift = np.linalg.norm(last["position"][-1] - self.steps[0]["position"][~self.ended], axis=1)
        over = "robots that held to the end"
        return {
            "holding_rate": rate(~self.ended, "robots"),
            "paw_force_range_mean_n": mean(spread, over),
            "paw_force_range_max_n": largest(spread, over),
            "lost_paw_share_mean": mean((last["force"] < CONTACT_FORCE).mean(axis=(0, 2)), over),
            "torque_ripple_mean_nm": mean(ripple, over),
            "torque_ripple_max_nm": largest(ripple, over),
            "drift_mean_m": mean(drift, over),
        }

    def columns(self) -> dict[str, list]:
        """Return whether the episode of each robot ended early, by name."""
        return {"ended": self.ended.tolist()}

    def series(self) -> dict[str, np.ndarray]:
        """Return the last force [N] on every paw of all worlds."""
        names = ("front left", "front right", "back left", "back right")
        return {f"force/{name} of {{}} [N]": self.steps[-1]["force"][:, paw] for paw, name in enumerate(names)}


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags of the test of held squats."""

    policy: str = "vertical_jump"  # Name or folder of a policy that jumps, a run's folder, or a checkpoint
    num_squats: int = 100  # Number of robots
    hold_time: float = 3.0  # [s] Time for which each robot waits
    height: tuple[float, float] = (0.6, 1.1)  # [m] Lowest and highest goal, for a policy that jumps to heights
    distance: tuple[float, float] = (0.3, 1.5)  # [m] Nearest and farthest goal, for a policy that jumps to places


def main(args: Args) -> dict:
    """Simulate the waiting robots, and return the metrics."""
    run = EvaluationRun.from_args("squat_hold", args, JumpEvaluation)
    goals = np.zeros((args.num_squats, 3))
    up = run.evaluation.kind == "height"
    goals[:, 2 if up else 0] = np.linspace(*(args.height if up else args.distance), args.num_squats)
    squats = run.run_episodes(run.env(args.num_squats), SquatLog(goals, args.hold_time), film="holds")
    run.settings["hold_s"] = args.hold_time
    return run.report(squats.metrics(), {}, SUMMARY)


if __name__ == "__main__":
    run_script(main, Args)

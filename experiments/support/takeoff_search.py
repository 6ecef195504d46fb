"""Search of fixed actions for the farthest or highest jump, by an evolution strategy on an environment of the task.

Actions are equal left and right, knots over time that are interpolated to policy steps.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.jumps import jump_commands
from jumper_warp.evaluation.log import termination_names
from jumper_warp.evaluation.places import ENDS, PlaceLog
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.registry import make_task
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError
from support.takeoffs import LANDING_ACTION, Act, Takeoffs, fly, mean_of_sides

TICKS = 48
"""Policy steps that are searched; the last action is held until takeoff."""
KNOTS = np.array([0, 8, 16, *range(24, TICKS)], dtype=float)
"""Policy steps at which actions are chosen; in between they are interpolated."""
WEIGHTS = np.stack([np.interp(np.arange(TICKS), KNOTS, unit) for unit in np.eye(len(KNOTS))], axis=1)
"""What each knot contributes to each policy step, (TICKS, knots)."""
SIGMA, FURTHER_SIGMA = 0.3, 0.1
"""[1] Standard deviation of the actions where a search begins, and where it goes on after a change."""
MOST_PITCH = 30.0
"""[deg] At landing, either way."""
BAD, PITCH, BACK, OUTSIDE = 1.0, 0.05, 5.0, 0.05
"""Costs of a jump that ended [m], pitch beyond the limit [m/deg], leaning back beyond it [1], wild knots [m]."""
NO_TAKEOFF = -3.0
"""[m] What a jump counts that does not leave the ground."""
POLICY_GOALS = (1.5, 2.0, 2.5)
"""[m]"""
SEED_GOAL = 2.0
"""[m] The policy's actions for this goal begin the search."""
EVERY = 120
"""Generations between two lines of progress."""


@dataclass(frozen=True)
class Limit:
    """Something that may limit the jump, as it is changed."""

    label: str
    task: Callable[[TaskCfg], TaskCfg] = lambda task: task
    model: Callable[[Env], None] = lambda env: None
    stance: bool = True
    """Whether the base stays within 0.3 m of its start while standing."""
    pitch: float = MOST_PITCH
    """[deg] Most at landing."""
    back: float = math.inf
    """[m] Farthest that the base may go back before takeoff."""
    apex: bool = False
    """Whether to search for the highest apex instead of the farthest landing."""


def cma_package() -> ModuleType:
    """Return the package `cma`. Raises InputError if it is not installed."""
    try:
        import cma
    except ImportError as error:
        raise InputError('this experiment needs the package cma: pip install "cma>=4"') from error
    return cma


NOMINAL = Limit("nominal")


def env_of_limit(limit: Limit, population: int, device: str | None = None, gravity: float | None = None) -> Env:
    """Return nominal robots on the task, one limit changed, with the ends that a search needs."""
    task = limit.task(make_task("horizontal-jump"))
    task = task if gravity is None else replace(task, gravity=gravity)
    names = {*ENDS, "left_stance"} - {"no_jump"} if limit.stance else {*ENDS} - {"no_jump"}
    task = replace(task, terminations=tuple(term for term in task.terminations if term.name in names))
    env = Env(task, population, device=device, randomize=False, noise=False, auto_reset=False)
    limit.model(env)
    return env


def score(takeoffs: Takeoffs, limit: Limit) -> np.ndarray:
    """Return what the search is for [m], less penalties; (num_envs,)."""
    apex = takeoffs.com[:, 2] + takeoffs.com_vel[:, 2] ** 2 / (2.0 * takeoffs.gravity)
    value = (apex if limit.apex else takeoffs.flight) - BAD * takeoffs.bad
    value -= PITCH * np.maximum(np.degrees(np.abs(takeoffs.landing_pitch)) - limit.pitch, 0.0)
    value -= BACK * np.maximum(takeoffs.back - limit.back, 0.0)
    return np.where(takeoffs.off & np.isfinite(value), value, NO_TAKEOFF)


def actions_of(knots: np.ndarray) -> np.ndarray:
    """Return actions (n, TICKS, 4) of candidates (n, 4 x knots)."""
    return np.einsum("tk,nkm->ntm", WEIGHTS, np.clip(knots, -1.0, 1.0).reshape(len(knots), len(KNOTS), 4))


def knots_of(actions: np.ndarray) -> np.ndarray:
    """Return the candidate whose actions are nearest to some (policy steps, 4), the last of which come last."""
    rows = actions[-TICKS:]
    rows = np.concatenate([np.repeat(rows[:1], TICKS - len(rows), axis=0), rows])
    return np.clip(np.linalg.lstsq(WEIGHTS, rows, rcond=None)[0], -1.0, 1.0).ravel()


def random_squat(env: Env, limit: Limit, seed: int) -> np.ndarray:
    """Return the best (n,) of 32 generations: two postures, then stretched legs, front and hind at their times."""
    rng, found, shape = np.random.default_rng(seed), [], (env.num_envs, 1, 4)
    for _ in range(32):
        first, second = rng.uniform(-1.0, 1.0, shape), rng.uniform(-0.2, 1.0, shape)
        change = rng.uniform(8.0, 32.0, (env.num_envs, 1, 1))
        stretch = np.repeat(rng.uniform(28.0, 44.0, (env.num_envs, 1, 2)), 2, axis=2)
        now = KNOTS[None, :, None]
        drawn = np.where(now < stretch, np.where(now < change, first, second), -1.0).reshape(env.num_envs, -1)
        scores = score(fly(env, actions_of(drawn)), limit)
        found.append((scores.max(), drawn[scores.argmax()]))
    return max(found, key=lambda pair: pair[0])[1]


def search(
    env: Env, limit: Limit, begin: np.ndarray, sigma: float, generations: int, seed: int
) -> tuple[np.ndarray, float]:
    """Return the best candidate (n,) found around `begin`, which is one of the first generation, and its score [m]."""
    settings = {"popsize": env.num_envs, "seed": seed + 1, "verbose": -9}
    evolution = cma_package().CMAEvolutionStrategy(begin, sigma, settings)
    evolution.inject([begin], force=True)
    best, best_score, started = begin, -math.inf, time.perf_counter()
    for number in range(1, generations + 1):
        drawn = np.array(evolution.ask())
        inside = np.clip(drawn, -1.0, 1.0)
        scores = score(fly(env, actions_of(inside)), limit)
        if scores.max() > best_score:
            best, best_score = inside[scores.argmax()], float(scores.max())
        evolution.tell(list(drawn), list(OUTSIDE * ((drawn - inside) ** 2).sum(axis=1) - scores))
        if number % EVERY == 0 or number == generations:
            seconds = time.perf_counter() - started
            print(f"{limit.label}: generation {number}, best {best_score:.3f} m, {seconds:.0f} s", flush=True)
    return best, best_score


def fly_best(
    env: Env, best: np.ndarray, after: float | Act = LANDING_ACTION, goals: np.ndarray | None = None
) -> Takeoffs:
    """Return jumps of the same candidate in every world, to their rest; after, goals: as of `fly`."""
    return fly(env, actions_of(np.tile(best, (env.num_envs, 1))), after, goals=goals, to_rest=True)


def fly_policy(run: EvaluationRun) -> tuple[Takeoffs, PlaceLog, np.ndarray]:
    """Let the policy jump to POLICY_GOALS; return the jumps, and its actions up to takeoff for SEED_GOAL (steps, 4)."""
    env, seed = run.env(len(POLICY_GOALS)), POLICY_GOALS.index(SEED_GOAL)
    env.evaluation_reset(jump_commands(np.zeros((env.num_envs, 3)), 0.0, env.step_dt))
    takeoffs, actions = Takeoffs(env), []

    def watch(_: PlaceLog) -> None:
        if not takeoffs.off[seed]:
            actions.append(mean_of_sides(env.action[seed].cpu().numpy())[0])
        takeoffs.look()

    goals = np.outer(POLICY_GOALS, [1.0, 0.0])[:, None]
    landings = run.follow(env, PlaceLog(goals, termination_names(env.task)), watch=watch)
    return takeoffs, landings, np.array(actions)

"""Observation terms that several tasks share, with the noise standard deviations of the paper's Table VI."""

from dataclasses import replace

from jumper_warp.kernels.mdp import observations as obs
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.terms import ObservationTerm
from jumper_warp.tasks.units import DEG

POSITION_NOISE = 0.005  # [m] of the base's height and of the position of a goal

ROBOT = (
    ObservationTerm(obs.lin_vel, noise=0.1),
    ObservationTerm(obs.ang_vel, noise=0.1),
    ObservationTerm(obs.gravity, noise=0.05),  # 0.5 m/s^2 of 9.81
    ObservationTerm(obs.angle, noise=3.0 * DEG),
    ObservationTerm(obs.rate, noise=10.0 * DEG),
    ObservationTerm(obs.last_action),
)
"""Observation terms common to the paper's policies: velocities, gravity direction, motors and last action."""

PAPER_ROBOT = tuple(term.replace(noise_limit=10.0) if term.numbers["noise"] else term for term in ROBOT)
"""The same terms with the paper's Gaussian noise: it is not cut (10 standard deviations do not occur)."""

DRAWN = (
    ObservationTerm(obs.drawn_mass),
    ObservationTerm(obs.drawn_com),
    ObservationTerm(obs.drawn_gains),
    ObservationTerm(obs.drawn_speed_limits),
    ObservationTerm(obs.drawn_latency),
    ObservationTerm(obs.drawn_friction),
    ObservationTerm(obs.drawn_offset),
    ObservationTerm(obs.drawn_push),
)
"""Observation terms of a world's randomised parameters, for critics."""

REMEMBERED = ("lin_vel", "ang_vel", "gravity", "angle", "last_action")
"""Names of the terms that `remembered` extends over several policy steps."""


def remembered(terms: tuple[ObservationTerm, ...], steps: int = 4) -> tuple[ObservationTerm, ...]:
    """Return copies of observation terms; those named in REMEMBERED get a history of `steps` policy steps."""
    return tuple(term.replace(history=steps) if term.name in REMEMBERED else term for term in terms)


def with_history(task: TaskCfg, steps: int | None) -> TaskCfg:
    """Return a task whose actor observes the terms REMEMBERED over `steps` policy steps; None: the task unchanged."""
    if steps is None:
        return task
    return replace(task, observations=replace(task.observations, actor=remembered(task.observations.actor, steps)))


def exact(terms: tuple[ObservationTerm, ...]) -> tuple[ObservationTerm, ...]:
    """Return copies of observation terms without noise and delay."""
    return tuple(term.replace(noise=0.0, delayed=False) for term in terms)

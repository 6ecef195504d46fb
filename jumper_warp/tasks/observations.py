"""Observation terms that the tasks share, with the noise of the paper's Table VI."""

from dataclasses import replace

from jumper_warp.kernels.mdp import observations as obs
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.terms import ObservationTerm
from jumper_warp.tasks.units import DEG

POSITION_NOISE = 0.005
"""[m] Of the base's height and of the way to a goal."""

ROBOT = (
    ObservationTerm(obs.lin_vel, noise=0.1),
    ObservationTerm(obs.ang_vel, noise=0.1),
    ObservationTerm(obs.gravity, noise=0.05),  # 0.5 m/s^2 of 9.81
    ObservationTerm(obs.angle, noise=3.0 * DEG),
    ObservationTerm(obs.rate, noise=10.0 * DEG),
    ObservationTerm(obs.last_action),
)
"""Velocity, gravity, motors and last action, as the paper's policies see them."""

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
"""What was drawn for the world and matters most, for the critic."""


REMEMBERED = ("lin_vel", "ang_vel", "gravity", "angle", "last_action")
"""Observations of which policies see the last steps too."""


def remembered(terms: tuple[ObservationTerm, ...], steps: int = 4) -> tuple[ObservationTerm, ...]:
    """Return terms of which some span several policy steps, from which noise, latency and motors can be told."""
    return tuple(term.replace(history=steps) if term.name in REMEMBERED else term for term in terms)


def with_history(task: TaskCfg, steps: int | None) -> TaskCfg:
    """Return the task whose policy sees so many policy steps; None: as it is."""
    if steps is None:
        return task
    return replace(task, observations=replace(task.observations, actor=remembered(task.observations.actor, steps)))


def exact(terms: tuple[ObservationTerm, ...]) -> tuple[ObservationTerm, ...]:
    """Return terms without noise and without delay."""
    return tuple(term.replace(noise=0.0, delayed=False) for term in terms)

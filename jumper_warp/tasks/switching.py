"""One robot with several skills, walking, jumps and turning in flight, and the handovers between them.

A jump begins only from where its training did: at rest on four paws near the default pose, to which walking brings the
robot when it is commanded to stand. The jump is commanded as soon as it takes over, since walking stands more quietly
than the jump policies hold a squat. Once landed and at rest, or if a landing went wrong, walking takes over. Each skill
has its own observation, action scale, gains, torque limits and command filter.

In a long flight a jump hands over to turning when it is asked to, which brings the base level, in the jump's heading,
and hands back shortly before the landing.
"""

from __future__ import annotations

from dataclasses import replace

from jumper_warp.kernels.attitude.state import AttitudeState
from jumper_warp.kernels.jump.state import JumpState
from jumper_warp.kernels.mdp import terminations
from jumper_warp.kernels.skills import handovers
from jumper_warp.kernels.velocity.state import VelocityState
from jumper_warp.tasks.cfg import Handover, TaskCfg
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.terms import TerminationTerm
from jumper_warp.tasks.units import DEG
from jumper_warp.utils.errors import InputError

FALLS, FALLS_FROM_FLIGHT = (
    (
        TerminationTerm(terminations.came_apart),
        TerminationTerm(terminations.collided),
        TerminationTerm(tilt, angle=60.0 * DEG),
        TerminationTerm(terminations.low_base, height=0.10),
    )
    for tilt in (terminations.tilted, terminations.fallen)
)
"""What ends the episode of a robot that switches, whatever its skill, and of one that turns in flight at any tilt."""


def for_switching(
    task: TaskCfg, randomization: RandomizationCfg, falls: tuple[TerminationTerm, ...] = FALLS
) -> TaskCfg:
    """Return a task of which only a fall ends an episode, on level ground, without what a training needs.

    randomization: of the robot, which all its skills share.
    """
    task = replace(
        task,
        terminations=falls,
        randomization=randomization,
        events=(),
        rewards=(),
        observations=replace(task.observations, critic=()),
        metrics=(),
    )
    return task.on_level_ground()


def flight_skills(jump: TaskCfg, turning: TaskCfg) -> tuple[list[TaskCfg], list[Handover]]:
    """Return the tasks of a robot that turns in the flight of a jump, the jump first, and their handovers.

    Gravity and randomisation are the jump's; the momentum of free flight is kept.
    Raises InputError: a task is no jump, or not one of turning.
    """
    for task, state in ((jump, JumpState), (turning, AttitudeState)):
        if task.state is not state:
            raise InputError(f"turning in flight needs a task of {state.key} here, got {task.name}")
    randomization = replace(jump.randomization, resample_at="reset")
    jump, turning = (
        for_switching(
            replace(task, gravity=jump.gravity, eval_height_offset=jump.eval_height_offset, keep_momentum=True),
            randomization,
            FALLS_FROM_FLIGHT,
        )
        for task in (jump, turning)
    )
    return [jump, turning], [
        Handover(jump, turning, handovers.jump_to_turn_due, handovers.begin_turn),
        Handover(turning, jump, handovers.turn_to_jump_due, handovers.begin_landing),
    ]


def skills_and_handovers(walking: TaskCfg, jumps: tuple[TaskCfg, ...]) -> tuple[list[TaskCfg], list[Handover]]:
    """Return the tasks of one robot, walking first, and the handovers between it and each jump.

    The robot is randomised as for the last jump: walking has seen more of everything but friction.
    Raises InputError: a task is not one of velocity tracking, or not a jump.
    """
    for task, state in ((walking, VelocityState), *((jump, JumpState) for jump in jumps)):
        if task.state is not state:
            raise InputError(f"switching needs a task of {state.key} here, got {task.name}")
    randomization = replace((jumps[-1] if jumps else walking).randomization, resample_at="reset")
    walk = for_switching(walking, randomization)
    tasks, found = [walk], []
    for jump in jumps:
        tasks.append(for_switching(jump, randomization))
        found.append(Handover(walk, tasks[-1], handovers.walk_to_jump_due, handovers.begin_jump))
        found.append(Handover(tasks[-1], walk, handovers.jump_to_walk_due, handovers.begin_walk))
    return tasks, found

"""One robot with several skills: walking, standing in between, and jumps, and the handovers between them.

A jump begins only from where its training did: walking comes to a stop, a stand takes the motor targets to the default
pose, and the jump is commanded as soon as it takes over. Once landed and at rest, or if a landing went wrong, walking
takes over. Each skill has its own observation, action scale, gains, torque limits and command filter.
"""

from __future__ import annotations

from dataclasses import replace

from jumper_warp.tasks.cfg import Command, Handover, Reset, TaskCfg
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.terms import Advance, Curriculum, ObservationTerm, TerminationTerm
from jumper_warp.tasks.units import DEG
from jumper_warp.utils.errors import InputError
from kernels.jump.state import JumpState
from kernels.mdp import observations as obs
from kernels.mdp import terminations
from kernels.skills import handovers, stand
from kernels.velocity.state import VelocityState

FALLS = (
    TerminationTerm(terminations.came_apart),
    TerminationTerm(terminations.collided),
    TerminationTerm(terminations.tilted, angle=60.0 * DEG),
    TerminationTerm(terminations.low_base, height=0.10),
)
"""What ends the episode of a robot that switches, whatever its skill."""


def for_switching(task: TaskCfg, randomization: RandomizationCfg) -> TaskCfg:
    """Return a task of which only a fall ends an episode, on level ground, without what a training needs.

    randomization: of the robot, which all its skills share.
    """
    task = replace(task, terminations=FALLS, randomization=randomization, events=(), rewards=(), critic=(), metrics=())
    return task.on_level_ground()


def stand_task(walking: TaskCfg) -> TaskCfg:
    """Return the stand that follows a walking task: its motors, filter and scale, so that nothing jumps.

    Its action is the last one times the observed `kept`; there is nothing to learn. A command is the goal of the jump
    to come: x, y relative to base and heading [m], base height at the apex [m].
    """
    return replace(
        walking,
        name="stand",
        state=stand.StandState,
        advance=Advance(stand.advance_stand),
        reset=Reset(stand.reset_stand),
        command=Command(stand.give_stand),
        curriculum=Curriculum(stand.no_error, tolerance=1.0, counts=stand.no_episode),
        policy=(ObservationTerm(stand.kept), ObservationTerm(obs.last_action)),
        levels=(),
        evaluation="episode",
    )


def skills_and_handovers(walking: TaskCfg, jumps: tuple[TaskCfg, ...]) -> tuple[list[TaskCfg], list[Handover]]:
    """Return the tasks of one robot, walking and standing first, and the handovers between them.

    The robot is randomised as for the last jump: walking has seen more of everything but friction.
    Raises InputError: a task is not one of velocity tracking, or not a jump.
    """
    for task, state in ((walking, VelocityState), *((jump, JumpState) for jump in jumps)):
        if task.state is not state:
            raise InputError(f"switching needs a task of {state.key} here, got {task.name}")
    randomization = replace((jumps[-1] if jumps else walking).randomization, redraw="reset")
    walk = for_switching(walking, randomization)
    still = stand_task(walk)
    tasks = [walk, still, *(for_switching(task, randomization) for task in jumps)]
    found = [
        Handover(walk, still, handovers.come_to_a_stop, handovers.begin_stand),
        Handover(still, walk, handovers.walk_again, handovers.begin_walk),
    ]
    for jump in tasks[2:]:
        found.append(Handover(still, jump, handovers.ready_to_jump, handovers.begin_jump))
        found.append(Handover(jump, walk, handovers.landed_or_lost, handovers.begin_walk_after_jump))
    return tasks, found

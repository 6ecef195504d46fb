"""One robot with several skills, walking and jumps, and the handovers between them.

A jump begins only from where its training did: at rest on four paws near the default pose, to which walking brings the
robot when it is commanded to stand. The jump is commanded as soon as it takes over, since walking stands more quietly
than the jump policies hold a squat. Once landed and at rest, or if a landing went wrong, walking takes over. Each skill
has its own observation, action scale, gains, torque limits and command filter.
"""

from __future__ import annotations

from dataclasses import replace

from jumper_warp.tasks.cfg import Handover, TaskCfg
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.terms import TerminationTerm
from jumper_warp.tasks.units import DEG
from jumper_warp.utils.errors import InputError
from kernels.jump.state import JumpState
from kernels.mdp import terminations
from kernels.skills import handovers
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


def skills_and_handovers(walking: TaskCfg, jumps: tuple[TaskCfg, ...]) -> tuple[list[TaskCfg], list[Handover]]:
    """Return the tasks of one robot, walking first, and the handovers between it and each jump.

    The robot is randomised as for the last jump: walking has seen more of everything but friction.
    Raises InputError: a task is not one of velocity tracking, or not a jump.
    """
    for task, state in ((walking, VelocityState), *((jump, JumpState) for jump in jumps)):
        if task.state is not state:
            raise InputError(f"switching needs a task of {state.key} here, got {task.name}")
    randomization = replace((jumps[-1] if jumps else walking).randomization, redraw="reset")
    walk = for_switching(walking, randomization)
    tasks, found = [walk], []
    for jump in jumps:
        tasks.append(for_switching(jump, randomization))
        found.append(Handover(walk, tasks[-1], handovers.come_to_a_stop, handovers.begin_jump))
        found.append(Handover(tasks[-1], walk, handovers.landed_or_lost, handovers.begin_walk))
    return tasks, found

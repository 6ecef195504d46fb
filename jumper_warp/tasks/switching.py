"""Tasks of a robot with several skills (walking, jumping), and rules for switching between them.

A jump starts as in its training: at rest on four paws near the default pose, which walking reaches when it is commanded
to stand. The jump command is set at the handover, since the walking policy stands with less motion than a waiting jump
policy. Walking takes over once the robot has landed and rests, or after a failed landing. Each skill has its own
observation, action scale, gains, torque limits and command filter.
"""

from __future__ import annotations

from dataclasses import replace

from jumper_warp.kernels.jump.state import JumpState
from jumper_warp.kernels.mdp import terminations
from jumper_warp.kernels.skills import handovers
from jumper_warp.kernels.velocity.state import VelocityState
from jumper_warp.tasks.cfg import Handover, TaskCfg
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.terms import TerminationTerm
from jumper_warp.tasks.units import DEG
from jumper_warp.utils.errors import InputError

FALLS = (
    TerminationTerm(terminations.diverged),
    TerminationTerm(terminations.collided),
    TerminationTerm(terminations.tilted, angle=60.0 * DEG),
    TerminationTerm(terminations.low_base, height=0.10),
)
"""Terminations of a robot that switches between skills."""


def for_switching(task: TaskCfg, randomization: RandomizationCfg) -> TaskCfg:
    """Return a copy of a task for a robot that switches between skills, on level ground; only FALLS end its episodes.

    It has no rewards, critic, events and metrics. randomization: ranges for the robot, the same in all its skills.
    """
    task = replace(
        task,
        terminations=FALLS,
        randomization=randomization,
        events=(),
        rewards=(),
        observations=replace(task.observations, critic=()),
        metrics=(),
    )
    return task.on_level_ground()


def skills_and_handovers(walking: TaskCfg, jumps: tuple[TaskCfg, ...]) -> tuple[list[TaskCfg], list[Handover]]:
    """Return the tasks [walking, *jumps] of one robot, and the rules (`Handover`) that switch to each jump and back.

    One robot has one set of parameters, so that all tasks have the same ranges: those of the last jump or, without
    jumps, of walking. The ranges of a jump suit walking too: except for friction, the default ranges for walking
    (`RandomizationCfg.walking`) are at least as wide as the default ranges for jumping. `resample_at="reset"`:
    parameters other than pushes are sampled at every reset, not once at startup; a handover is no reset.
    Raises InputError: `walking` is no velocity task, or a jump no jump task.
    """
    for task, state in ((walking, VelocityState), *((jump, JumpState) for jump in jumps)):
        if task.state is not state:
            raise InputError(f"switching needs a task with {state.key}, got {task.name}")
    randomization = replace((jumps[-1] if jumps else walking).randomization, resample_at="reset")
    walk = for_switching(walking, randomization)
    tasks = [walk]
    switches = []
    for jump in jumps:
        tasks.append(for_switching(jump, randomization))
        switches.append(Handover(walk, tasks[-1], handovers.walk_to_jump_due, handovers.begin_jump))
        switches.append(Handover(tasks[-1], walk, handovers.jump_to_walk_due, handovers.begin_walk))
    return tasks, switches

"""Left-right mirror maps of observations and actions, as permutations and signs.

`signs * x[order]` is the observation x, or the action, of the robot mirrored about its x-z plane. Lateral angles are
positive outward, and transversal angles away from the leg's other link, so motors swap sides and keep their signs.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jumper_warp.kernels.attitude import observations as attitude
from jumper_warp.kernels.jump import observations as jump
from jumper_warp.kernels.mdp import observations as obs
from jumper_warp.kernels.velocity import observations as velocity
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError


class Mirror(NamedTuple):
    """Left-right mirror map: a permutation and signs; the mirror image of a vector x is `signs * x[order]`."""

    order: np.ndarray  # (columns,) int, source column of each column
    signs: np.ndarray  # (columns,) float32, 1 or -1


LEGS = (1, 0, 3, 2)  # indices of FL, FR, BL, BR with sides swapped: FR, FL, BR, BL
MOTORS = tuple(3 * leg + j for leg in LEGS for j in range(3))  # motor indices with sides swapped
ROWS = tuple(3 * (i // 3) + 2 - i % 3 for i in range(15))  # points of `ground_heights`: 5 rows of 3 across
RAYS = (4, 5, 2, 3, 0, 1, 6)  # columns of `block_ahead`: (begin, end) of left, middle, right ray; height
VECTOR, AXIAL = (1, -1, 1), (-1, 1, -1)  # signs of x, y, z of a vector, and of a rotation vector, body axes

_PLAIN: dict[Any, tuple[int, ...]] = {
    obs.lin_vel: VECTOR, obs.ang_vel: AXIAL, obs.gravity: VECTOR, velocity.command: (1, -1, -1),
    velocity.gait_phase: (-1, -1), velocity.command_age: (1,), velocity.push: VECTOR + AXIAL, obs.height: (1,),
    attitude.turn_left: (*AXIAL, 1), attitude.time_left: (1,), attitude.in_collision: (1,),
    jump.wanted_height: (1,), jump.jump_command: (1,), jump.goal: (1, -1), jump.phase: (1, 1, 1),
    jump.phase_times: (1, 1), jump.height_errors: (1, 1), jump.landing_miss: (1, -1), jump.way: (1, -1),
    obs.drawn_mass: (1, 1), obs.drawn_com: VECTOR, obs.drawn_latency: (1,), obs.drawn_friction: (1, 1),
}  # fmt: skip
"""Column signs of mirrored observations by the term's function, for terms whose columns keep their order."""
_SWAPPED: dict[Any, tuple[int, ...]] = {
    obs.angle: MOTORS, obs.rate: MOTORS, obs.last_action: MOTORS, obs.contacts: LEGS, obs.air_times: LEGS,
    obs.paw_forces: LEGS, velocity.contact_times: LEGS, velocity.paw_heights: LEGS, velocity.recent_steps: LEGS,
    velocity.ground_heights: ROWS, jump.block_ahead: RAYS, obs.drawn_gains: MOTORS,
    obs.drawn_speed_limits: MOTORS, obs.drawn_offset: MOTORS,
}  # fmt: skip
"""Column orders of mirrored observations by the term's function, for terms whose columns keep their signs."""


def mirror_of(task: TaskCfg, group: str) -> Mirror:
    """Return the left-right mirror map of a task's observation; group: "actor" or "critic".

    Raises InputError: unknown term.
    """
    order: list[int] = []
    signs: list[int] = []
    for term in getattr(task.observations, group):
        width = term.width
        if term.func in _PLAIN:
            columns, flips = tuple(range(width)), _PLAIN[term.func]
        elif term.func in _SWAPPED:
            columns, flips = _SWAPPED[term.func], (1,) * width
        else:
            raise InputError(f"{task.name} {group}: the mirror image of {term.name} is not known")
        for _ in range(term.options["history"]):
            first = len(order)
            order += [first + column for column in columns]
            signs += flips
    return Mirror(np.array(order), np.array(signs, dtype=np.float32))


def mirror_of_action() -> Mirror:
    """Return the left-right mirror map of an action (12,), in motor order."""
    return Mirror(np.array(MOTORS), np.ones(12, dtype=np.float32))

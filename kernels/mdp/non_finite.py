"""Record of the first non-finite value of each term of a task (reward, observation, ...), with its world's state.

Kernels replace NaN by 0 so that training continues; the record lets the host report which term failed, and in which
state, without checking after every step.
"""

from typing import Any

import warp as wp

from ..layout import COORDS, DOFS
from .env import EpisodeArrays
from .view import RobotArrays

NO_WORLD = wp.constant(-1)  # `NonFinite.world` of a term that was always finite


@wp.struct
class NonFinite:
    """First non-finite value of each term of a task in each slice (range) of worlds; arrays of (slices * terms, ...).

    Terms: the rewards, the curriculum, the diverged state, then the observations of all groups. Each slice has its own
    records: on a CPU, threads advance the slices at the same time, without atomic operations.
    """

    world: wp.array(dtype=int)  # NO_WORLD: all values were finite
    step: wp.array(dtype=int)  # step count of the world after the policy step
    value: wp.array(dtype=float)
    joint_q: wp.array2d(dtype=float)  # (..., 43) of the world, as in Newton
    joint_qd: wp.array2d(dtype=float)  # (..., 38)
    action: wp.array2d(dtype=float)  # (..., 12)
    observations: wp.array2d(dtype=float)  # (..., components) last values of the observation terms
    rewards: wp.array2d(dtype=float)  # (..., rewards) of the policy step, weights applied
    observation_term: wp.array(dtype=int)  # (components,) index of the term among the observations
    num_rewards: int
    num_terms: int


@wp.func
def record_non_finite(
    found: NonFinite, term: int, value: float, world: int, episode: EpisodeArrays, arrays: RobotArrays,
    raw: wp.array2d(dtype=float), term_value: wp.array2d(dtype=float), states: Any, found_states: Any,
):  # fmt: skip
    """Store a term's non-finite value with the world's state, unless the term has a record already.

    Many worlds may fail at once: the first to swap its index into `found.world` (compare-and-swap) writes the record.
    raw: (components, num_worlds); term_value: (rewards, num_worlds); states, found_states: task states of the worlds
    and of the records.
    """
    row = episode.slice * found.num_terms + term
    if found.world[row] != NO_WORLD:
        return
    if wp.atomic_cas(found.world, row, NO_WORLD, world) != NO_WORLD:
        return
    found.step[row] = episode.step_count[world]
    found.value[row] = value
    found_states[row] = states[world]
    for i in range(int(COORDS)):
        found.joint_q[row, i] = arrays.joint_q[world * COORDS + i]
    for i in range(int(DOFS)):
        found.joint_qd[row, i] = arrays.joint_qd[world * DOFS + i]
    for i in range(found.action.shape[1]):
        found.action[row, i] = arrays.action[i, world]
    for i in range(found.observations.shape[1]):
        found.observations[row, i] = raw[i, world]
    for i in range(found.rewards.shape[1]):
        found.rewards[row, i] = term_value[i, world]

"""Rejection sampling of start states: up to 8 attempts in one thread, or on a GPU all at once in 8 x 4 threads.

Joint angles come from the closed-form inverse kinematics and joint rates from the leg's Jacobian, so that every state
satisfies the leg loops. A sample is rejected if a paw is out of reach within limits or a link collides. On a GPU the 32
threads of a world are one warp: lane 4 a + l (`RngStream.lane`) samples leg l of attempt a, and all threads reach each
exchange of `lanes` together. Each thread has coordinates of one world to itself until an attempt is accepted. The first
valid attempt wins in both cases, so that a CPU and a GPU take the same samples. `rng.lanes`: 1 or 32 threads.
"""

from typing import Any

import warp as wp

from ..collision.robot import leg_collisions
from ..kinematics.geometry import LegGeometry, leg_of
from ..lanes import all_of_attempt, from_leg_of_attempt, least_of_attempts, sync_lanes
from ..layout import COORDS, DOFS
from ..scalar import vec3
from ..state import leg_coord, leg_dof, load_motors, store_motors
from ..terrain.ground import Ground
from .env import Scene
from .random import RngStream, fold_in
from .starts import MIN_LINK_DISTANCE, LegSample
from .view import RobotArrays

wp.set_module_options({"enable_backward": False})

ATTEMPTS = wp.constant(8)
LANES = 32  # Threads of a GPU that share a world's attempts


@wp.func
def first_leg(rng: RngStream) -> int:
    """Return the first leg (0 to 3) that this thread samples."""
    return rng.lane % 4


@wp.func
def leg_step(rng: RngStream) -> int:
    """Return the increment of this thread's loop over legs: 1 if it samples all four legs, 4 if it samples one."""
    return wp.min(rng.lanes, 4)


@wp.func
def all_legs(rng: RngStream, flag: bool) -> bool:
    """Return whether `flag` is true for all legs of the start state that this thread's attempt samples."""
    if rng.lanes > 1:
        return all_of_attempt(flag)
    return flag


@wp.func
def vec_from_leg(v: vec3, leg: int) -> vec3:
    """Return the vector `v` of the thread that samples leg `leg`, in all four threads of the sampling attempt."""
    return vec3(from_leg_of_attempt(v[0], leg), from_leg_of_attempt(v[1], leg), from_leg_of_attempt(v[2], leg))


@wp.func
def sync_attempts(rng: RngStream):
    """Synchronise the threads that sample a world's start state; no effect with one thread per world.

    Values that a thread has written before the call are visible to all threads after it. No thread overwrites a value
    before all threads have read it.
    """
    if rng.lanes > 1:
        sync_lanes()


@wp.func
def store_leg(leg: int, sample: LegSample, joint_q: wp.array(dtype=float), joint_qd: wp.array(dtype=float)):
    """Write a leg's motor angles [rad] and rates [rad/s] to joint coordinates of one world, (COORDS,) and (DOFS,)."""
    store_motors(joint_q, leg_coord(0, leg), sample.angles)
    store_motors(joint_qd, leg_dof(0, leg), sample.rates)


@wp.func
def pose_is_valid(
    geometry: wp.array(dtype=LegGeometry), ground: Ground, rng: RngStream, sample: LegSample, reachable: bool,
    joint_q: wp.array(dtype=float), joint_qd: wp.array(dtype=float),
) -> bool:  # fmt: skip
    """Return whether a sampled pose is valid: all four legs are reachable and free of collisions.

    The threads of an attempt exchange their legs. sample: last leg that this thread sampled; reachable: whether all
    legs of this thread are reachable. joint_q (COORDS,) and joint_qd (DOFS,): coordinates of the attempt, completed
    here.
    """
    legs = wp.int32(4)
    all_reachable = all_legs(rng, reachable)
    if rng.lanes == 1 and not all_reachable:
        return False  # several lanes must all reach the exchange below
    if rng.lanes > 1:
        gathered = LegSample()
        for leg in range(legs):
            gathered.angles = vec_from_leg(sample.angles, leg)
            gathered.rates = vec_from_leg(sample.rates, leg)
            store_leg(leg, gathered, joint_q, joint_qd)
    flags = int(0)
    for leg in range(first_leg(rng), legs, leg_step(rng)):
        flags = flags | leg_collisions(geometry, ground, joint_q, rng.world, 0, leg, MIN_LINK_DISTANCE)
    return all_legs(rng, all_reachable and flags == 0)


@wp.func
def write_sample_and_check(
    sample_base: wp.Function, sample_leg: wp.Function, start: Any, arrays: RobotArrays, scene: Scene, rng: RngStream,
    attempt: int, joint_q: wp.array(dtype=float), joint_qd: wp.array(dtype=float),
) -> bool:  # fmt: skip
    """Sample base and legs of one attempt at a start state, and return whether the pose is valid.

    joint_q (COORDS,), joint_qd (DOFS,): coordinates of attempt `attempt`, written here. sample_base, sample_leg, start:
    see `sample_valid_state`. rng: stream of the attempt.
    """
    base = sample_base(start, arrays, rng, attempt)
    for j in range(3):
        joint_q[j] = base.pos[j]
        joint_qd[j] = base.com_vel[j]
        joint_qd[3 + j] = base.ang_vel[j]
    for j in range(4):
        joint_q[3 + j] = base.quat[j]
    reachable = bool(True)
    sample = LegSample()
    legs = wp.int32(4)
    for leg in range(first_leg(rng), legs, leg_step(rng)):
        sample = sample_leg(start, base, leg_of(scene.geometry, rng.world, leg), rng, leg)
        reachable = reachable and sample.reachable
        store_leg(leg, sample, joint_q, joint_qd)
    return pose_is_valid(scene.geometry, start.ground, rng, sample, reachable, joint_q, joint_qd)


@wp.func
def write_first_valid(
    rng: RngStream, accepted: int, attempt_q: wp.array(dtype=float), attempt_qd: wp.array(dtype=float),
    joint_q: wp.array(dtype=float), joint_qd: wp.array(dtype=float),
) -> bool:  # fmt: skip
    """Copy the first valid attempt to the world's coordinates in `joint_q`, `joint_qd`; return whether there is one.

    accepted: valid attempt of this thread, `ATTEMPTS` if none; attempt_q (COORDS,), attempt_qd (DOFS,): its sample.
    """
    legs = wp.int32(4)
    first = accepted
    if rng.lanes > 1:
        first = least_of_attempts(accepted)
    if accepted == first and first < ATTEMPTS and first_leg(rng) == 0:
        for i in range(7):
            joint_q[rng.world * COORDS + i] = attempt_q[i]
        for i in range(6):
            joint_qd[rng.world * DOFS + i] = attempt_qd[i]
        for leg in range(legs):
            store_motors(joint_q, leg_coord(rng.world, leg), load_motors(attempt_q, leg_coord(0, leg)))
            store_motors(joint_qd, leg_dof(rng.world, leg), load_motors(attempt_qd, leg_dof(0, leg)))
    sync_attempts(rng)
    return first < ATTEMPTS


@wp.func
def sample_valid_state(
    sample_base: wp.Function, sample_leg: wp.Function, start: Any, arrays: RobotArrays, scene: Scene, rng: RngStream
) -> bool:
    """Sample a start state by rejection: write the first valid one of `ATTEMPTS` attempts to world `rng.world`.

    Return whether any is valid; else nothing is written. A task's `start_states` define start: struct of values that
    all attempts share, with the `ground` of the world; sample_base: (start, arrays, rng, attempt) -> struct with pos
    [m], quat (xyzw), com_vel [m/s] and ang_vel [rad/s] of the base, world axes; sample_leg: (start, base, geometry,
    rng, leg) -> `LegSample`.
    """
    attempt_q = wp.zeros(shape=(COORDS,), dtype=float)
    attempt_qd = wp.zeros(shape=(DOFS,), dtype=float)
    accepted = int(ATTEMPTS)
    for attempt in range(rng.lane // 4, ATTEMPTS, wp.max(rng.lanes // 4, 1)):
        if accepted == ATTEMPTS:
            branch = fold_in(rng, attempt)
            if write_sample_and_check(
                sample_base, sample_leg, start, arrays, scene, branch, attempt, attempt_q, attempt_qd
            ):
                accepted = attempt
    return write_first_valid(rng, accepted, attempt_q, attempt_qd, arrays.joint_q, arrays.joint_qd)

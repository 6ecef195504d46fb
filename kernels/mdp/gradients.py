"""Rewards and observations of a policy step as differentiable functions of the robot's state.

Phase machine, events and the set of paws in contact are constants of a step: the gradient belongs to the branch of this
step. Contact forces are variables.
"""

from typing import Any

import warp as wp

from ..kinematics.geometry import LegGeometry, leg_of
from ..terrain.ground import Ground
from .factory import unrolled_kernel
from .observe import store
from .parameters import RobotParameters
from .track import paw_clearance, paw_motion
from .view import RobotArrays, load_view

OPTIONS: dict[str, Any] = {"enable_backward": True, "fast_math": True}


def make_gradient_kernel(task: Any) -> wp.Kernel:
    """Return the kernel that evaluates a task's rewards and the policy's observation terms, with a reverse pass.

    task: see `jumper_warp.tasks.cfg.TaskCfg`.
    """
    (advance,), rewards = (task.params.slots[name] for name in ("advance", "rewards"))
    slots = task.params.slots["observations.actor"]
    kinds = [next(iter(slot.func.input_types.values())) for slot in slots]
    constant = [kind is RobotParameters for kind in kinds]
    reads_arrays = [kind is RobotArrays for kind in kinds]
    rows = [sum(slot.term.width for slot in slots[:i]) for i in range(len(slots))]

    def gradient_kernel(
        # in
        arrays: RobotArrays,
        ground: Ground,
        states: wp.array(dtype=task.state),
        p: wp.array(dtype=float),
        # out
        term_value: wp.array2d(dtype=float),
        raw: wp.array2d(dtype=float),
    ):
        """Evaluate rewards, weights applied, (rewards, num_worlds), and observation terms, (components, num_worlds).

        One thread per world. states: states of the task before the step. Robot parameters that a policy observes are
        constants: their rows of `raw` stay.
        """
        world = wp.tid()
        robot = load_view(arrays, ground, world)
        state = wp.static(advance.func)(robot, states[world], *p[wp.static(advance.start) : wp.static(advance.stop)])
        for i in range(wp.static(len(rewards))):
            weight = p[wp.static(rewards[i].weight)]
            if wp.static(bool(rewards[i].scale_by_dt)):
                weight = weight * arrays.step_dt
            if weight != 0.0:
                term_value[i, world] = weight * wp.static(rewards[i].func)(
                    robot, state, *p[wp.static(rewards[i].start) : wp.static(rewards[i].stop)]
                )
        for i in range(wp.static(len(slots))):
            if wp.static(reads_arrays[i]):
                store(wp.static(slots[i].func)(arrays, ground, world), wp.static(rows[i]), world, raw)
            elif wp.static(not constant[i]):
                store(
                    wp.static(slots[i].func)(robot, state, *p[wp.static(slots[i].start) : wp.static(slots[i].stop)]),
                    wp.static(rows[i]), world, raw,
                )  # fmt: skip

    return unrolled_kernel(gradient_kernel, task.state, options=OPTIONS)


@wp.kernel(module="unique", module_options=OPTIONS)
def paw_gradient_kernel(
    # in
    geometry: wp.array(dtype=LegGeometry),
    ground: Ground,
    arrays: RobotArrays,
    # out
    pos: wp.array2d(dtype=wp.vec3),
    vel: wp.array2d(dtype=wp.vec3),
    height: wp.array2d(dtype=float),
):
    """Write position [m], velocity [m/s] and height above the ground [m] of every paw, (4, num_worlds)."""
    leg, world = wp.tid()
    paw = paw_motion(arrays, leg_of(geometry, world, leg), world, leg)
    pos[leg, world] = paw.pos
    vel[leg, world] = paw.vel
    height[leg, world] = paw_clearance(leg_of(geometry, world, leg), ground, world, paw.pos)

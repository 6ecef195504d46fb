"""Commands of the attitude task: goal orientations, sampled at random or set from Python (`Env.command`).

Quaternions are xyzw, body to world; body axes are x ahead, y left, z up. A random number is identified by its index in
a stream (`streams`), and `fold_in` derives an independent stream.
"""

import warp as wp

from ..mdp.env import Scene
from ..mdp.random import RngStream, fold_in, uniform, uniform_range
from ..mdp.view import RobotView
from . import streams
from .state import AttitudeState, with_goal

wp.set_module_options({"enable_backward": False})


@wp.struct
class TurnRanges:
    """Ranges from which the rotation to a goal orientation is sampled, body axes."""

    angle: wp.vec2  # [rad] (smallest, largest)
    body_axis_probability: float  # of an axis +-x, +-y or +-z, as evaluations use; else uniform over the sphere


@wp.func
def sample_unit_quat(rng: RngStream) -> wp.quat:
    """Return a random orientation (xyzw), uniform over all orientations (Shoemake 1992)."""
    a = uniform(rng, streams.QUAT, 0.0, 1.0)
    b = uniform(rng, streams.QUAT + 1, 0.0, 2.0 * wp.pi)
    c = uniform(rng, streams.QUAT + 2, 0.0, 2.0 * wp.pi)
    s = wp.sqrt(1.0 - a)
    r = wp.sqrt(a)
    return wp.quat(s * wp.sin(b), s * wp.cos(b), r * wp.sin(c), r * wp.cos(c))


@wp.func
def sample_axis(rng: RngStream, body_axis_probability: float) -> wp.vec3:
    """Return a random unit vector, body axes: a body axis with `body_axis_probability`, else any direction.

    Body axes (+-x, +-y or +-z) and directions on the sphere are uniformly distributed.
    """
    sign = wp.where(uniform(rng, streams.SIGN, 0.0, 1.0) < 0.5, -1.0, 1.0)
    if uniform(rng, streams.ALONG_BODY, 0.0, 1.0) < body_axis_probability:
        axis = wp.vec3(0.0)
        axis[wp.min(int(uniform(rng, streams.BODY_AXIS, 0.0, 3.0)), 2)] = sign
        return axis
    z = uniform(rng, streams.AXIS_Z, -1.0, 1.0)
    around = uniform(rng, streams.AXIS_AROUND, 0.0, 2.0 * wp.pi)
    r = wp.sqrt(1.0 - z * z)
    return wp.vec3(r * wp.cos(around), r * wp.sin(around), z)


@wp.func
def sample_rotation(rng: RngStream, ranges: TurnRanges) -> wp.quat:
    """Return a sampled rotation (xyzw) to a goal orientation: axis in body axes, angle from `ranges.angle`."""
    axis = sample_axis(fold_in(rng, streams.AXIS_BRANCH), ranges.body_axis_probability)
    return wp.quat_from_axis_angle(axis, uniform_range(rng, streams.ANGLE, ranges.angle))


@wp.func
def set_turn(robot: RobotView, scene: Scene, state: AttitudeState, values: wp.vec4, heading: float) -> AttitudeState:
    """Return the task state whose goal is the present orientation rotated by the quaternion `values` (xyzw, body axes).

    The command is relative, so that it means the same for any start. values: quaternion of any length; zeros: no
    rotation. scene and heading are unused (signature of `command.set`).
    """
    turn = wp.quat(values[0], values[1], values[2], values[3])
    if wp.length(values) == 0.0:
        turn = wp.quat(0.0, 0.0, 0.0, 1.0)
    return with_goal(state, robot.quat, robot.quat * wp.normalize(turn))

"""Cost of the planned motion of a jump, with a reverse pass: a weighted sum of terms over the rows of a trajectory.

The ground is level, at height 0. The weights depend on the row, so that a term can count after the landing only.
"""

import warp as wp

from ..collision.robot import SHANK_FREE, LegCapsules, leg_capsules, leg_leg_distance, leg_shell_distance
from ..kinematics.geometry import LegGeometry, leg_of
from ..scalar import quat, real, vec3

HEIGHT = wp.constant(0)  # rows of the weights: squared error of the base's height [m^2]
PLACE = wp.constant(1)  # squared horizontal distance of the base from the goal [m^2]
REST = wp.constant(2)  # squared velocity of the base [m^2/s^2], a tenth of its squared angular velocity [rad^2/s^2]
TILT = wp.constant(3)  # squared sine of the angle between body z and world z
POSE = wp.constant(4)  # sum of squared differences of the motor angles from the pose of rest [rad^2]
GAP = wp.constant(5)  # sum of squared distances [m^2] that links and shell lack to `MARGIN`
TERMS = wp.constant(6)
MARGIN = wp.constant(real(0.02))  # [m] Distance from the ground, the shell and other legs
SHELL = wp.constant(vec3(real(0.343), real(0.112), real(-0.049)))  # [m] lower corner of the shell's bounding box


@wp.func
def lacking_sq(height: real, radius: real) -> real:
    """Return the squared height [m^2] by which a sphere of a radius [m] is too low for its margin above the ground."""
    lacking = wp.max(MARGIN + radius - height, real(0.0))
    return lacking * lacking


@wp.func
def leg_lacking_sq(geo: LegGeometry, leg: LegCapsules, z: real, up: vec3) -> real:
    """Return the sum of `lacking_sq` [m^2] over a leg's housing, knees and shanks.

    z: height of the base [m]; up: world z in body axes.
    """
    tip = geo.hip + vec3(geo.front * geo.housing_length, real(0.0), real(0.0))
    total = lacking_sq(z + wp.dot(up, geo.hip), geo.housing_radius) + lacking_sq(
        z + wp.dot(up, tip), geo.housing_radius
    )
    ankle = z + wp.dot(up, leg.ends[4])
    outer = z + wp.dot(up, leg.ends[2])
    inner = z + wp.dot(up, leg.ends[3])
    total = total + lacking_sq(outer, geo.thigh_radius) + lacking_sq(inner, geo.thigh_radius)
    total = total + lacking_sq(outer + SHANK_FREE * (ankle - outer), geo.shank_radius)
    return total + lacking_sq(inner + SHANK_FREE * (ankle - inner), geo.shank_radius)


@wp.func
def motor_angles(q: wp.array3d(dtype=real), row: int, world: int, leg: int) -> vec3:
    """Return the angles [rad] of a leg's motors in a row of trajectories."""
    return vec3(q[row, 7 + 3 * leg, world], q[row, 8 + 3 * leg, world], q[row, 9 + 3 * leg, world])


@wp.kernel(module="unique", module_options={"enable_backward": True})
def plan_cost_kernel(
    # in
    geometry: wp.array(dtype=LegGeometry),
    pose: wp.array2d(dtype=real),
    goal: wp.array2d(dtype=real),
    weight: wp.array3d(dtype=real),
    q: wp.array3d(dtype=real),
    qd: wp.array3d(dtype=real),
    # out
    cost: wp.array(dtype=real),
):
    """Add the cost of a row of each world's trajectory, one thread per row, world and leg, to `cost` (num_worlds,).

    pose: (12, num_worlds) [rad] of rest; goal: (3, num_worlds) [m] place x, y and height; weight: (rows, TERMS,
    num_worlds); q, qd: as in `Trajectory`.
    """
    row, world, leg = wp.tid()
    rotation = wp.quat_to_matrix(quat(q[row, 3, world], q[row, 4, world], q[row, 5, world], q[row, 6, world]))
    up = vec3(rotation[2, 0], rotation[2, 1], rotation[2, 2])
    z = q[row, 2, world]
    motor = 3 * leg
    angles = motor_angles(q, row, world, leg)
    geo = leg_of(geometry, world, leg)
    capsules = leg_capsules(geo, angles[0], angles[1], angles[2])
    neighbour = (leg + 2) % 4  # the other leg of its side
    beside = motor_angles(q, row, world, neighbour)
    others = leg_capsules(leg_of(geometry, world, neighbour), beside[0], beside[1], beside[2])
    off = angles - vec3(pose[motor, world], pose[motor + 1, world], pose[motor + 2, world])
    total = weight[row, POSE, world] * wp.dot(off, off)
    # every leg has the corner of the shell at its own end and side
    corner = vec3(geo.front * SHELL[0] * geo.shell[0], geo.side * SHELL[1] * geo.shell[1], SHELL[2] * geo.shell[2])
    lacking = leg_lacking_sq(geo, capsules, z, up) + lacking_sq(z + wp.dot(up, corner), real(0.0))
    apart = MARGIN - leg_shell_distance(capsules, MARGIN)
    between = MARGIN - leg_leg_distance(capsules, others, MARGIN)
    total = total + weight[row, GAP, world] * (lacking + apart * apart + real(0.5) * between * between)
    if leg == 0:
        high = z - goal[2, world]
        total = total + weight[row, HEIGHT, world] * high * high
        x = q[row, 0, world] - goal[0, world]
        y = q[row, 1, world] - goal[1, world]
        total = total + weight[row, PLACE, world] * (x * x + y * y)
        vel = vec3(qd[row, 0, world], qd[row, 1, world], qd[row, 2, world])
        ang = vec3(qd[row, 3, world], qd[row, 4, world], qd[row, 5, world])
        total = total + weight[row, REST, world] * (wp.dot(vel, vel) + real(0.1) * wp.dot(ang, ang))
        total = total + weight[row, TILT, world] * (up[0] * up[0] + up[1] * up[1])
    wp.atomic_add(cost, world, total)

"""Inverse kinematics of the legs in closed form: paw positions to motor and knee angles, for batches of robots.

A reachable target takes one closed-form solution: the lateral angle from the circle that the leg's plane touches, then
each thigh angle from the triangle of thigh, shank and the line to the ankle, knees outward. Within the joint limits
every ankle position has exactly one such solution, and `five_bar` returns the same ankle for it.

For an unreachable target the result is the pose within limits whose ankle is nearest to it: a coarse grid over
both thigh angles, then a compass search around the best point, with the lateral angle solved exactly at each. The
residual is within 1 mm of the true least distance, and most often within 1 micrometre.

No gradients are generated for this file; the derivative is the inverse of `leg.leg_jacobian`.

Targets are in body axes (x ahead, y left, z up). Motor angles are lateral (positive outward), outer and inner (positive
away from the leg's other thigh). Housing axes are body axes turned about x by the lateral motor. `front`: +1 front leg,
-1 back leg; `side`: +1 left, -1 right.
"""

import warp as wp

from ..scalar import quat, real, vec2, vec3
from .five_bar import five_bar
from .geometry import LegGeometry, leg_of
from .leg import knee_angles, leg_forward_kinematics, paw_in_housing, rotate_lateral

wp.set_module_options({"enable_backward": False})

REACHED = wp.constant(real(1.0e-5))  # [m] A pose whose ankle is this close to its target reaches it
FAR = wp.constant(real(10.0))
"""[m] Targets farther from the hip than this along an axis are scaled toward the hip before the search."""
GRID = wp.constant(9)  # Grid points per thigh angle at the start of the search
ROUNDS = wp.constant(40)  # Largest number of rounds of the compass search
FINEST = wp.constant(real(5.0e-5))  # [rad] The compass search ends below this step


@wp.struct
class LegLimits:
    """Joint limits of a leg [rad]; outer and inner motor share `transversal`. Lower must not exceed upper."""

    lateral_lower: real
    lateral_upper: real  # at most a full turn above lower
    transversal_lower: real  # above -90 degrees
    transversal_upper: real  # below 180 degrees
    sum_lower: real  # of outer + inner; above the pose in which the knees coincide
    sum_upper: real


@wp.struct
class LegPose:
    """Motor and knee angles of a leg that bring its ankle to a target position, or nearest to it."""

    motors: vec3  # [rad] lateral, outer, inner
    knees: vec2  # [rad] outer, inner; passive
    reachable: int  # 1: the ankle is at the target (within 1e-5 m); 0: it is at the nearest point within limits
    residual: real  # [m] distance from ankle to target; infinite for a target that is not finite


@wp.func
def clamp_transversal(limits: LegLimits, outer: real, inner: real) -> vec2:
    """Return the thigh angles (outer, inner) [rad] clamped to joint limits.

    Where the sum is out of limits, only `inner` is corrected. `outer` is first limited so that some `inner` fits.
    """
    lower = limits.transversal_lower
    upper = limits.transversal_upper
    clamped_outer = wp.clamp(outer, wp.max(lower, limits.sum_lower - upper), wp.min(upper, limits.sum_upper - lower))
    clamped_inner = wp.clamp(
        inner, wp.max(lower, limits.sum_lower - clamped_outer), wp.min(upper, limits.sum_upper - clamped_outer)
    )
    return vec2(clamped_outer, clamped_inner)


@wp.func
def nearest_lateral(geo: LegGeometry, limits: LegLimits, target: vec3, ankle_z: real) -> real:
    """Return the lateral angle [rad] within limits that brings the ankle nearest to a target [m] relative to the hip.

    ankle_z [m]: the ankle's z in the housing frame. The ankle moves on a circle about x, so the result is the angle
    toward the target, clamped to the limit that is nearer around the circle.
    """
    toward = geo.side * (wp.atan2(target[2], target[1]) - wp.atan2(ankle_z, geo.plane_y + geo.knee_y))
    middle = real(0.5) * (limits.lateral_lower + limits.lateral_upper)
    half = real(0.5) * (limits.lateral_upper - limits.lateral_lower)
    full_turn = real(6.283185307179586)  # arithmetic on wp.pi would be single precision
    off = toward - middle
    off_wrapped = off - full_turn * wp.round(off / full_turn)
    return middle + wp.clamp(off_wrapped, -half, half)


@wp.func
def thigh_angle(geo: LegGeometry, shank: real, away: real, z: real) -> real:
    """Return the motor angle [rad] at which a thigh's shank reaches a point, with its knee away from the other thigh.

    shank [m]: knee to point. away [m]: point from the thigh's axis along x, positive away from the other thigh; z [m]:
    of the point in the housing frame. Out of reach, the leg is stretched or folded toward the point (`wp.acos` clamps
    its argument).
    """
    distance_sq = wp.max(away * away + z * z, real(1.0e-12))
    cosine = (distance_sq + geo.thigh * geo.thigh - shank * shank) / (real(2.0) * geo.thigh * wp.sqrt(distance_sq))
    return wp.atan2(away, -z) + wp.acos(cosine)


@wp.func
def clamped_closed_form(geo: LegGeometry, limits: LegLimits, target: vec3) -> vec3:
    """Return closed-form motor angles [rad] for a paw target [m], clamped to limits; if out of reach, a first guess.

    target: from the hip, body axes.
    """
    plane = geo.plane_y + geo.knee_y
    z = -wp.sqrt(wp.max(target[1] * target[1] + target[2] * target[2] - plane * plane, real(0.0)))
    inner = thigh_angle(geo, geo.shank + geo.paw_offset, geo.front * (geo.inner_x - target[0]), z)
    # the ankle is on the line from the paw to the inner knee
    beyond = geo.paw_offset / (geo.shank + geo.paw_offset)
    knee = vec2(geo.inner_x - geo.front * geo.thigh * wp.sin(inner), -geo.thigh * wp.cos(inner))
    ankle_x = target[0] + beyond * (knee[0] - target[0])
    outer = thigh_angle(geo, geo.outer_shank, geo.front * (ankle_x - geo.outer_x), z + beyond * (knee[1] - z))
    thighs = clamp_transversal(limits, outer, inner)
    return vec3(nearest_lateral(geo, limits, target, z), thighs[0], thighs[1])


@wp.func
def nearest_ankle(geo: LegGeometry, limits: LegLimits, target: vec3, thighs: vec2) -> vec3:
    """Return the ankle position nearest to `target` for fixed thigh angles [rad]; both [m] from the hip, body axes."""
    ankle = paw_in_housing(geo, five_bar(geo, thighs[0], thighs[1]))
    return rotate_lateral(geo, nearest_lateral(geo, limits, target, ankle[2]), ankle)


@wp.func
def grid_thighs(limits: LegLimits, row: int, col: int) -> vec2:
    """Return the thigh angles [rad], outer and inner, of point (row, col) of a GRID x GRID grid within joint limits.

    The range of `inner` depends on `outer`, because their sum is limited too.
    """
    lower = limits.transversal_lower
    upper = limits.transversal_upper
    along_row = real(row) / real(GRID - 1)
    along_col = real(col) / real(GRID - 1)
    outer_lower = wp.max(lower, limits.sum_lower - upper)
    outer_upper = wp.min(upper, limits.sum_upper - lower)
    outer = outer_lower + along_row * (outer_upper - outer_lower)
    inner_lower = wp.max(lower, limits.sum_lower - outer)
    inner_upper = wp.min(upper, limits.sum_upper - outer)
    return vec2(outer, inner_lower + along_col * (inner_upper - inner_lower))


@wp.func
def nearest_reachable(geo: LegGeometry, limits: LegLimits, target: vec3, guess: vec2) -> vec3:
    """Search for the reachable ankle position nearest to `target`, and return it; both [m] from the hip, body axes.

    guess: first candidate (outer, inner) [rad] within limits. The search is over thigh angles; see the module.
    """
    directions = 9  # a variable: a loop over a constant would be unrolled
    best = vec2(guess[0], guess[1])
    best_miss = real(wp.length_sq(nearest_ankle(geo, limits, target, best) - target))
    for n in range(GRID * GRID):
        thighs = grid_thighs(limits, n / GRID, n % GRID)
        miss = wp.length_sq(nearest_ankle(geo, limits, target, thighs) - target)
        if miss < best_miss:
            best = thighs
            best_miss = miss
    step = real(0.5) * (limits.transversal_upper - limits.transversal_lower) / real(GRID - 1)
    for _ in range(ROUNDS):
        center = best
        center_miss = best_miss
        for n in range(directions):
            thighs = clamp_transversal(limits, center[0] + step * real(n / 3 - 1), center[1] + step * real(n % 3 - 1))
            miss = wp.length_sq(nearest_ankle(geo, limits, target, thighs) - target)
            if miss < best_miss:
                best = thighs
                best_miss = miss
        if best_miss == center_miss:
            step = real(0.5) * step
        if step < FINEST:
            break
    return nearest_ankle(geo, limits, target, best)


@wp.func
def leg_inverse_kinematics(geo: LegGeometry, limits: LegLimits, ankle_body: vec3) -> LegPose:
    """Return the leg's pose for a target ankle position [m] in the body frame, the nearest one if out of reach.

    A non-finite target is replaced by the point a shank's length below the middle of the two transversal axes (with
    reachable 0 and an infinite residual); no result is ever NaN.
    """
    pose = LegPose()
    finite = wp.isfinite(ankle_body)
    below = vec3(real(0.5) * (geo.outer_x + geo.inner_x), geo.plane_y + geo.knee_y, -geo.shank)
    from_hip = wp.where(finite, ankle_body - geo.hip, below)
    farthest = wp.max(wp.max(wp.abs(from_hip[0]), wp.abs(from_hip[1])), wp.abs(from_hip[2]))
    target = from_hip * (FAR / wp.max(farthest, FAR))
    motors = clamped_closed_form(geo, limits, target)
    miss = wp.length(leg_forward_kinematics(geo, motors[0], motors[1], motors[2]) - geo.hip - target)
    if miss > REACHED:
        motors = clamped_closed_form(geo, limits, nearest_reachable(geo, limits, target, vec2(motors[1], motors[2])))
    ankle = leg_forward_kinematics(geo, motors[0], motors[1], motors[2])
    residual = wp.where(finite, wp.length(ankle - ankle_body), real(wp.inf))
    pose.motors = motors
    pose.knees = knee_angles(geo, five_bar(geo, motors[1], motors[2]), motors[1], motors[2])
    pose.reachable = wp.where(miss > REACHED or not finite, 0, 1)
    pose.residual = residual
    return pose


@wp.kernel
def paws_kernel(
    # in
    geometry: wp.array(dtype=LegGeometry),
    motors: wp.array2d(dtype=real),
    # out
    paws: wp.array2d(dtype=vec3),
):
    """Write paw centres [m] (4, n) in the body frame for motor angles [rad] (12, n) of n robots; launch over (4, n)."""
    leg, robot = wp.tid()
    m = 3 * leg
    paws[leg, robot] = leg_forward_kinematics(
        leg_of(geometry, robot, leg), motors[m, robot], motors[m + 1, robot], motors[m + 2, robot]
    )


@wp.kernel
def inverse_kinematics_kernel(
    # in
    geometry: wp.array(dtype=LegGeometry),
    limits: LegLimits,
    base_pos: wp.array(dtype=vec3),
    base_quat: wp.array(dtype=quat),
    paws: wp.array2d(dtype=vec3),
    paws_in_world: int,
    # out
    motors: wp.array2d(dtype=real),
    knees: wp.array2d(dtype=real),
    reachable: wp.array2d(dtype=wp.int32),
    residual: wp.array2d(dtype=real),
):
    """Write the joint angles that put the paws at target positions; launch over (4, n) for n robots.

    geometry: see `leg_of`. base_pos [m] (n,), base_quat (n,) xyzw, unit: body to world. paws [m] (4, n): target centres
    of the paws, in the body frame, or in the world frame if `paws_in_world` is 1 (the base is not read otherwise).
    motors (12, n), knees (8, n: outer, inner per leg) [rad]. reachable (4, n), residual [m] (4, n): see `LegPose`.
    """
    leg, robot = wp.tid()
    paw = paws[leg, robot]
    if paws_in_world == 1:
        paw = wp.quat_rotate_inv(base_quat[robot], paw - base_pos[robot])
    pose = leg_inverse_kinematics(leg_of(geometry, robot, leg), limits, paw)
    for joint in range(3):
        motors[3 * leg + joint, robot] = pose.motors[joint]
    knees[2 * leg, robot] = pose.knees[0]
    knees[2 * leg + 1, robot] = pose.knees[1]
    reachable[leg, robot] = pose.reachable
    residual[leg, robot] = pose.residual

"""Detection of a robot's forbidden contacts: links or body shell with the ground, and links with links or shell.

Paws may touch the ground; that contact belongs to the dynamics. Each leg is five capsules (two thighs, two shanks,
the paw as a capsule of zero length) whose ends come from the five-bar in closed form, the housings are capsules
along the lateral axes, and the shell is four boxes. Distances between links are computed in the body frame (x ahead, y
left, z up). Every distance is signed: positive apart, negative where the shapes overlap. Legs are 0 to 3: FL, FR, BL,
BR. `bound` [m]: distance beyond which a pair does not matter, which saves most of the work.

Pairs that the mechanism keeps apart or together at any joint angle are not checked: a leg with its own housing and
with the motor drums at its own end of the body, around whose axis it turns at a fixed distance; thighs with the shanks
that hang from them; a paw with its own thighs; housings with one another and with other legs (a leg touches the shell
or its neighbour first).
"""

import warp as wp

from ..kinematics.five_bar import five_bar
from ..kinematics.geometry import LegGeometry, leg_of
from ..scalar import mat33, mat43, quat, real, vec3, vec4
from ..terrain.ground import Ground, ground_distance
from .distances import inflated_distance, segment_box_bound_sq, segment_box_sq, segment_segment_sq

wp.set_module_options({"enable_backward": False})

BODY_GROUND = wp.constant(1)  # bits of `Collisions.flags`; the body is the shell
HOUSING_GROUND = wp.constant(2)
THIGH_GROUND = wp.constant(4)
KNEE_GROUND = wp.constant(8)
SHANK_GROUND = wp.constant(16)
LEG_LEG = wp.constant(32)
LEG_SELF = wp.constant(64)
LEG_SHELL = wp.constant(128)

SHANK_FREE = wp.constant(real(0.9))  # fraction of a shank, from the knee, that must not touch the ground
SHANK_APART = wp.constant(real(0.5))  # fraction of a shank, from the knee, that must not touch the other shank
FAR = wp.constant(real(1.0e6))  # [m] start value of a minimum of distances

_ROLLED = """
#if defined(__CUDA_ARCH__)
    asm("" : "+r"(count));
#endif
    return count;
"""

mat53 = wp.types.matrix(shape=(5, 3), dtype=real)

# boxes of a shell of factor 1 (`LegGeometry.shell`) in the body frame [m], one a row:
# nose to tail, trunk, front motor drums, rear motor drums
SHELL_BOXES = wp.constant(4)
LOWER_CORNERS = wp.constant(4 * SHELL_BOXES)
SHELL_CENTER = wp.constant(mat43(0.0, 0.0, 0.025, 0.0, 0.0, 0.025, 0.1125, 0.0, 0.0, -0.112, 0.0, 0.0))
SHELL_HALF = wp.constant(mat43(0.343, 0.05, 0.074, 0.144, 0.112, 0.074, 0.0315, 0.154, 0.049, 0.032, 0.199, 0.049))


@wp.struct
class LegCapsules:
    """Capsules that model the links of one leg, in the body frame.

    Links 0 to 4 are outer thigh, inner thigh, outer shank, inner shank, paw. The capsule of link k goes from row k of
    `ends` to row `capsule_end(k)`, and has the radius `capsule_radius(capsules, k)`. Five rows suffice, because
    neighbouring links share an end.
    """

    ends: mat53  # [m] rows: outer transversal axis, inner transversal axis, outer knee, inner knee, centre of the paw
    low: vec3  # [m] smallest x, y and z of the ends
    high: vec3  # [m] largest x, y and z of the ends
    hip: vec3  # [m] see `LegGeometry`
    normal: vec3  # unit normal of the leg's plane
    offset: real  # [m] of the knees and the paw along the normal, from the hip
    geometry: LegGeometry


@wp.struct
class Collisions:
    """Forbidden contacts of one robot as bit flags, and the smallest distance [m] of all checked pairs."""

    flags: int  # bitmask of BODY_GROUND to LEG_SHELL
    clearance: real  # [m] smallest distance of all, negative in contact


@wp.func_native(_ROLLED)
def rolled(count: int) -> int:
    """Return `count`, hidden from a GPU's compiler, which cannot unroll a loop up to it: few threads wait for code."""
    ...


@wp.func
def leg_capsules(geo: LegGeometry, lateral: real, outer: real, inner: real) -> LegCapsules:
    """Return the capsules that model the links of one leg, in the body frame, for its motor angles [rad]."""
    loop = five_bar(geo, outer, inner)
    normal = vec3(real(0.0), wp.cos(lateral), geo.side * wp.sin(lateral))
    up = vec3(real(0.0), -normal[2], normal[1])
    forward = vec3(real(1.0), real(0.0), real(0.0))
    capsules = LegCapsules()
    capsules.offset = geo.plane_y + geo.knee_y
    root = geo.hip + geo.plane_y * normal
    plane = geo.hip + capsules.offset * normal
    outer_axis = root + geo.outer_x * forward
    inner_axis = root + geo.inner_x * forward
    outer_knee = plane + loop.outer_knee[0] * forward + loop.outer_knee[1] * up
    inner_knee = plane + loop.inner_knee[0] * forward + loop.inner_knee[1] * up
    paw = plane + loop.paw[0] * forward + loop.paw[1] * up
    capsules.ends = wp.matrix_from_rows(outer_axis, inner_axis, outer_knee, inner_knee, paw)
    capsules.low = wp.min(wp.min(wp.min(outer_axis, inner_axis), wp.min(outer_knee, inner_knee)), paw)
    capsules.high = wp.max(wp.max(wp.max(outer_axis, inner_axis), wp.max(outer_knee, inner_knee)), paw)
    capsules.hip = geo.hip
    capsules.normal = normal
    capsules.geometry = geo
    return capsules


@wp.func
def capsule_end(k: int) -> int:
    """Return the row of `LegCapsules.ends` that holds the far end of link k; the near end is in row k.

    Thighs (0, 1) end in the knees (rows 2, 3), shanks (2, 3) in the paw (row 4), as if the ankle were
    there, and the paw (4) begins and ends there.
    """
    return wp.min(k + 2, 4)


@wp.func
def capsule_radius(capsules: LegCapsules, k: int) -> real:
    """Return the radius [m] of link k: thighs 0 and 1, shanks 2 and 3, paw 4."""
    geo = capsules.geometry
    return wp.where(k < 2, geo.thigh_radius, wp.where(k < 4, geo.shank_radius, geo.paw_radius))


@wp.func
def leg_self_distance(capsules: LegCapsules, bound: real) -> real:
    """Return the smallest distance [m] between links of one leg, at most `bound` (>= 0) [m].

    Pairs: thigh to thigh, each thigh to the shank of the other, and shank to shank. The shanks join in the ankle, so
    only their upper parts (`SHANK_APART`) count.
    """
    outer_axis, inner_axis = capsules.ends[0], capsules.ends[1]
    outer_knee, inner_knee, paw = capsules.ends[2], capsules.ends[3], capsules.ends[4]
    thighs_sq = segment_segment_sq(outer_axis, outer_knee, inner_axis, inner_knee)
    outer_thigh_sq = segment_segment_sq(outer_axis, outer_knee, inner_knee, paw)
    inner_thigh_sq = segment_segment_sq(inner_axis, inner_knee, outer_knee, paw)
    span = SHANK_APART * (outer_knee - inner_knee)
    geo = capsules.geometry
    thighs = inflated_distance(thighs_sq, real(2.0) * geo.thigh_radius, bound)
    if geo.outer_x == geo.inner_x:
        thighs = bound  # thighs about one axis lie in two planes
    crossed = inflated_distance(wp.min(outer_thigh_sq, inner_thigh_sq), geo.thigh_radius + geo.shank_radius, bound)
    shanks = inflated_distance(wp.dot(span, span), real(2.0) * geo.shank_radius, bound)
    return wp.min(thighs, wp.min(crossed, shanks))


@wp.func
def leg_box_distance(capsules: LegCapsules, box: int, bound: real) -> real:
    """Return the distance [m] between a leg and box 0 to 3 of the shell (`SHELL_CENTER`), at most `bound` (>= 0)."""
    center = wp.cw_mul(SHELL_CENTER[box], capsules.geometry.shell)
    half = wp.cw_mul(SHELL_HALF[box], capsules.geometry.shell)
    nearest = bound
    # The whole leg lies in one plane: if the plane is clear of the box, so is every link. (The thighs' upper ends lie
    # knee_y inside the plane, which their radius, smaller than the paw's, offsets.)
    plane_gap = wp.abs(wp.dot(capsules.normal, capsules.hip - center) + capsules.offset) - wp.dot(
        wp.abs(capsules.normal), half
    )
    bounding_sq = segment_box_bound_sq(capsules.low - center, capsules.high - center, half)
    reach = bound + capsules.geometry.paw_radius
    if plane_gap < reach and bounding_sq < reach * reach:
        for k in range(rolled(5)):
            start = capsules.ends[k] - center
            end = capsules.ends[capsule_end(k)] - center
            radius = capsule_radius(capsules, k)
            if inflated_distance(segment_box_bound_sq(start, end, half), radius, nearest) < nearest:
                nearest = wp.min(nearest, inflated_distance(segment_box_sq(start, end, half), radius, bound))
    return nearest


@wp.func
def leg_shell_distance(capsules: LegCapsules, bound: real) -> real:
    """Return the distance [m] of a leg from the shell without the motor drums at its end of the body, up to `bound`.

    The leg turns around these drums at a fixed distance. Boxes: 0 nose to tail, 1 trunk, 2 front drums, 3 rear drums.
    """
    drums = wp.where(capsules.geometry.front > real(0.0), 3, 2)
    nearest = wp.min(leg_box_distance(capsules, 0, bound), leg_box_distance(capsules, 1, bound))
    return wp.min(nearest, leg_box_distance(capsules, drums, bound))


@wp.func
def box_gap_sq(low: vec3, high: vec3, other_low: vec3, other_high: vec3) -> real:
    """Return the squared distance [m^2] of two boxes along the axes, from their lowest and highest corners [m]."""
    gap = wp.max(wp.max(other_low - high, low - other_high), vec3(real(0.0)))
    return wp.dot(gap, gap)


@wp.func
def leg_leg_distance(leg: LegCapsules, neighbour: LegCapsules, bound: real) -> real:
    """Return the smallest distance [m] between thighs, shanks and paws of two legs, at most `bound` (>= 0) [m].

    Bounding boxes are compared first, those of the legs, of a link and a leg, of two links: most pairs are far apart.
    """
    reach = bound + leg.geometry.paw_radius + neighbour.geometry.paw_radius
    reach_sq = reach * reach
    nearest = bound
    if box_gap_sq(leg.low, leg.high, neighbour.low, neighbour.high) < reach_sq:
        for k in range(rolled(5)):
            start, end = leg.ends[k], leg.ends[capsule_end(k)]
            low, high = wp.min(start, end), wp.max(start, end)
            if box_gap_sq(low, high, neighbour.low, neighbour.high) < reach_sq:
                for m in range(rolled(5)):
                    other_start, other_end = neighbour.ends[m], neighbour.ends[capsule_end(m)]
                    if box_gap_sq(low, high, wp.min(other_start, other_end), wp.max(other_start, other_end)) < reach_sq:
                        radius = capsule_radius(leg, k) + capsule_radius(neighbour, m)
                        distance_sq = segment_segment_sq(start, end, other_start, other_end)
                        nearest = wp.min(nearest, inflated_distance(distance_sq, radius, bound))
    return nearest


@wp.func
def body_ground_distance(ground: Ground, shell: vec3, pos: vec3, rotation: mat33) -> real:
    """Return the smallest signed distance [m] of the shell from the ground, along the ground's normal, negative inside.

    shell [1]: see `LegGeometry`.

    Only the four lower corners of each shell box are tested: exact over a plane, but bumps of a heightfield between
    the corners (at most 0.2 m apart along x) are missed. pos: base position [m], world; rotation: body to world.
    """
    lower = wp.where(rotation[2, 2] < real(0.0), real(1.0), real(-1.0))  # sign of the body z that points down
    nearest = real(FAR)
    count = wp.int32(LOWER_CORNERS)
    for i in range(count):
        half = wp.cw_mul(SHELL_HALF[i // 4], shell)
        x = wp.where(i % 2 == 0, half[0], -half[0])
        y = wp.where((i // 2) % 2 == 0, half[1], -half[1])
        corner = wp.cw_mul(SHELL_CENTER[i // 4], shell) + vec3(x, y, lower * half[2])
        nearest = wp.min(nearest, ground_distance(ground, pos + rotation * corner))
    return nearest


@wp.func
def leg_ground_distances(ground: Ground, capsules: LegCapsules, pos: vec3, rotation: mat33) -> vec4:
    """Return the smallest distances [m] of a leg's housing, thighs, knees and shanks from the ground, negative inside.

    A knee is the end of its thigh; the thigh counts from its axis to its middle, the shank down to `SHANK_FREE`.
    Exact over a plane; over a heightfield links are tested every 0.09 m. pos: base position [m], world; rotation: body
    to world.
    """
    geo = capsules.geometry
    housing = ground_distance(ground, pos + rotation * capsules.hip)
    tip = capsules.hip + vec3(geo.front * geo.housing_length, real(0.0), real(0.0))
    housing = wp.min(housing, ground_distance(ground, pos + rotation * tip))
    thigh = real(FAR)
    knee = real(FAR)
    shank = real(FAR)
    paw_world = pos + rotation * capsules.ends[4]
    for i in range(rolled(12)):
        k = i // 6
        part = i % 6  # of the link: axis, middle of the thigh, knee, three points of the shank
        knee_world = pos + rotation * capsules.ends[k + 2]
        point = knee_world
        if part < 2:
            point = pos + rotation * capsules.ends[k]
        if part == 1:
            point = real(0.5) * (point + knee_world)
        if part > 2:
            point = knee_world + SHANK_FREE * real(part - 2) / real(3.0) * (paw_world - knee_world)
        distance = ground_distance(ground, point)
        if part < 2:
            thigh = wp.min(thigh, distance)
        elif part == 2:
            knee = wp.min(knee, distance)
        else:
            shank = wp.min(shank, distance)
    shank = wp.min(shank, knee)
    return vec4(
        housing - geo.housing_radius, thigh - geo.thigh_radius, knee - geo.thigh_radius, shank - geo.shank_radius
    )


@wp.func
def add_distance(collisions: Collisions, distance: real, least: real, flag: int) -> Collisions:
    """Return `collisions` with a clearance of at most `distance` [m], and with `flag` set if distance < least."""
    result = Collisions()
    result.flags = collisions.flags | wp.where(distance < least, flag, 0)
    result.clearance = wp.min(collisions.clearance, distance)
    return result


@wp.func
def load_leg(
    geometry: wp.array(dtype=LegGeometry), joint_q: wp.array(dtype=wp.float32), world: int, start: int, leg: int
) -> LegCapsules:
    """Return the capsules that model leg 0 to 3 of a world, whose coordinates begin at index `start` of joint_q.

    joint_q has 7 coordinates of the base, then the angles [rad] of each leg: lateral, outer, outer knee, inner, inner
    knee.
    """
    motor = start + 7 + 5 * leg
    return leg_capsules(
        leg_of(geometry, world, leg), real(joint_q[motor]), real(joint_q[motor + 1]), real(joint_q[motor + 3])
    )


@wp.func
def next_leg(order: int) -> int:
    """Return the index of the leg at position `order` (modulo 4) around the body: FL, FR, BR, BL are 0, 1, 3, 2.

    Each leg is compared with the next one around the body; diagonal legs are not compared.
    """
    return (order % 4) ^ ((order % 4) >> 1)


@wp.func
def add_leg_distances(
    collisions: Collisions, ground: Ground, leg: LegCapsules, neighbour: LegCapsules, pos: vec3, rotation: mat33,
    min_distance: real,
) -> Collisions:  # fmt: skip
    """Return `collisions` updated by one leg's distances to the ground, itself, the shell and the leg `neighbour`.

    pos [m], rotation: see `leg_ground_distances`. min_distance [m]: links closer than this to another link raise flags;
    the ground has no such margin.
    """
    zero = real(0.0)
    over_ground = leg_ground_distances(ground, leg, pos, rotation)
    result = add_distance(collisions, over_ground[0], zero, HOUSING_GROUND)
    result = add_distance(result, over_ground[1], zero, THIGH_GROUND)
    result = add_distance(result, over_ground[2], zero, KNEE_GROUND)
    result = add_distance(result, over_ground[3], zero, SHANK_GROUND)
    bound = wp.max(result.clearance, min_distance)
    result = add_distance(result, leg_self_distance(leg, bound), min_distance, LEG_SELF)
    result = add_distance(result, leg_shell_distance(leg, bound), min_distance, LEG_SHELL)
    return add_distance(result, leg_leg_distance(leg, neighbour, bound), min_distance, LEG_LEG)


@wp.func
def leg_collisions(
    geometry: wp.array(dtype=LegGeometry), ground: Ground, joint_q: wp.array(dtype=wp.float32), world: int, start: int,
    order: int, min_distance: real,
) -> int:  # fmt: skip
    """Return the flags of the forbidden contacts of one leg, at position `order` (0 to 3) around the body.

    Kernels with a thread per leg call this function. Order 0 also checks the shell against the ground. The union over
    all four orders has the flags of the robot. min_distance [m]: links closer than this to another link raise flags.
    """
    pos = vec3(real(joint_q[start]), real(joint_q[start + 1]), real(joint_q[start + 2]))
    rotation = wp.quat_to_matrix(
        quat(real(joint_q[start + 3]), real(joint_q[start + 4]), real(joint_q[start + 5]), real(joint_q[start + 6]))
    )
    collisions = Collisions()
    if order == 0:
        collisions = add_distance(
            collisions,
            body_ground_distance(ground, leg_of(geometry, world, 0).shell, pos, rotation),
            real(0.0),
            BODY_GROUND,
        )
    leg = load_leg(geometry, joint_q, world, start, next_leg(order))
    neighbour = load_leg(geometry, joint_q, world, start, next_leg(order + 1))
    return add_leg_distances(collisions, ground, leg, neighbour, pos, rotation, min_distance).flags

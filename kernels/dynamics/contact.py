"""Contact of the four paws with the ground: rigid, inelastic, Coulomb friction, solved for impulses.

At the end of a step each paw satisfies, with v the velocity of its contact point, n the normal, and impulse p:

    0 <= p_n  complementary to  v_n - v_free >= 0,      |p_t| <= mu p_n,
    p_t = -mu p_n v_t / |v_t|  where the paw slides,    v_t = 0 where it sticks,

v_free = -gap / dt closes an open gap exactly (code: `goal`). The four paws are coupled through the base alone,

    v_k = v_k0 + A_k p_k + G_k (change of base twist),   change of base twist = S^-1 sum_k G_k^T p_k,

with S the base's inertia with legs (6x6), so block Gauss-Seidel over the paws, each solved exactly as a 3x3 problem,
converges quickly. Vectors are in body axes. Impulses [N s] act from the ground on the paw; normals point out of the
ground, so that a positive normal velocity separates. Pressed hard stops are part of A and S (see `world_step`).

Velocities of paws that touch a sliding block are relative to it. The block obeys friction with the floor exactly, at
every stage of the iteration: its velocity is a function of the impulses (`block_velocity`), so that paws and block
agree at the end of a step, whatever the block's mass.
"""

import warp as wp

from ..scalar import mat33, real, vec2, vec3
from .base_dynamics import BaseInverse, LegSolve
from .inertia import skew
from .leg_dynamics import PawKinematics

PUSH_OUT = wp.constant(real(0.2))  # fraction of a penetration that is pushed out per step
PUSH_OUT_SPEED = wp.constant(real(1.0))  # largest speed of that push [m/s]
CONTACT_MARGIN = wp.constant(real(0.02))  # [m] a paw is solved for if its free motion leaves a smaller gap
STIFF_BAND = wp.constant(real(2.0e-6))  # [m] gaps up to this size, + or -, stay unchanged if the leg is on a hard stop
STICK_SPEED = wp.constant(real(0.01))  # [m/s] contacts slower than this start the step with static friction
# relative distance of a sliding paw's impulse from the friction cone
SLIDE_TOLERANCE = wp.constant(real(1.0e-6 if real is wp.float32 else 1.0e-13))
MAX_SLIDE_STEPS = wp.constant(24)  # of `sliding_impulse`; few are needed

SEPARATE = wp.constant(0)  # modes of a contact
STICK = wp.constant(1)
SLIDE = wp.constant(2)


@wp.struct
class PawContact:
    """Data of one paw's contact in a step: normal, friction, Jacobian and velocity responses to impulses.

    Vectors in body axes, motors lateral, outer, inner.
    """

    active: int  # 0: too far from the ground to touch within the step, and the impulse is 0
    on_block: int  # 1: the paw's nearest surface is the sliding block
    normal: vec3  # unit, out of the ground
    mu: real  # friction coefficient
    mu_row: int  # row of mu in the parameter table
    goal: real  # smallest admissible normal velocity at the end of the step [m/s]
    free: vec3  # contact point velocity without any impulse [m/s]
    jacobian: mat33  # contact velocity per motor rate [m/rad]
    from_lin: mat33  # G, linear part: contact velocity per base velocity [1]
    from_ang: mat33  # G, angular part: contact velocity per base angular velocity [m]
    to_lin: mat33  # S^-1 G^T: base velocity per impulse [1/kg]
    to_ang: mat33  # base angular velocity per impulse [1/(kg m)]
    leg_response: mat33  # A: contact velocity per impulse through the leg alone [1/kg]
    total_inv: mat33  # inverse of `total` [kg]
    total: mat33  # A + G S^-1 G^T, plus 1/mass of the block along the floor: relative velocity per impulse [1/kg]
    impulse: vec3  # [N s]


@wp.struct
class BlockLaw:
    """Values from which a sliding block's velocity at the end of a step is computed, body axes."""

    velocity: vec3  # at the start of the step [m/s]
    up: vec3  # world z
    mass: real  # [kg]
    friction: real  # coefficient of friction with the floor [1]
    weight: real  # impulse of the block's own weight on the floor [N s]


@wp.func
def contact_jacobian(paw: PawKinematics, arm: vec3) -> mat33:
    """Return the Jacobian of a paw's contact point w.r.t. motor angles [m/rad]; arm [m]: paw centre to point, body."""
    return paw.jacobian - skew(arm) * paw.spin


@wp.func
def target_normal_velocity(gap: real, pressed: int, dt: real) -> real:
    """Return the smallest admissible normal velocity [m/s] at the end of a step dt [s] for a gap [m], < 0 inside.

    An open gap closes exactly; penetration is pushed out. pressed: the leg's pressed hard stops. On stops a leg is
    stiff, and rounding errors of gaps would shift load between legs: gaps within `STIFF_BAND` then stay unchanged,
    and gaps slightly beyond it close by `PUSH_OUT` only.
    """
    beyond = gap
    if pressed != 0:
        beyond = gap - wp.clamp(gap, -STIFF_BAND, STIFF_BAND)
        beyond = wp.where(beyond > real(0.0), wp.max(PUSH_OUT * beyond, beyond - STIFF_BAND), beyond)
    if beyond > real(0.0):
        return -beyond / dt
    return wp.min(-PUSH_OUT * beyond / dt, PUSH_OUT_SPEED)


@wp.func
def couple_contact(contact: PawContact, point: vec3, leg: LegSolve, base: BaseInverse) -> PawContact:
    """Return `contact` with its velocity's responses to impulses on the paw, through the leg and the base, filled in.

    The function fills the fields `from_lin` to `total`. point [m]: point of contact from the base origin, body axes.
    """
    c = contact
    eye = wp.identity(n=3, dtype=real)
    leg_response = leg.inverse * wp.transpose(c.jacobian)
    c.from_lin = eye - c.jacobian * leg.to_lin
    c.from_ang = -skew(point) - c.jacobian * leg.to_ang
    lin_t = wp.transpose(c.from_lin)
    ang_t = wp.transpose(c.from_ang)
    c.to_lin = base.lin * lin_t + base.cross * ang_t
    c.to_ang = wp.transpose(base.cross) * lin_t + base.ang * ang_t
    c.leg_response = c.jacobian * leg_response
    c.total = c.leg_response + c.from_lin * c.to_lin + c.from_ang * c.to_ang
    c.total_inv = wp.inverse(c.total)
    return c


@wp.struct
class SlidingPaw:
    """Equation of a sliding paw's friction t [N s], along two axes of the surface: (M + s I) t = r.

    M is the response of the tangential velocity at constant normal velocity; s >= 0 is the slip per friction, since
    the slip is -s t. The paw's load is p_n = size - tilt . t.
    """

    first: vec3  # axis of the surface, unit, body axes
    second: vec3
    trace: real  # of M [1/kg]
    determinant: real  # of M [1/kg^2]
    right: vec2  # r [m/s]
    adjugate: vec2  # (trace I - M) r, so that t = (adjugate + s r) / det(M + s I)
    size: real  # load without friction [N s]
    tilt: vec2  # load that friction takes from the normal [1]


@wp.func
def sliding_paw(c: PawContact, free: vec3) -> SlidingPaw:
    """Return the equation of a paw's friction while it slides.

    free [m/s]: velocity of the contact point without an impulse on this paw, body axes.
    """
    n = c.normal
    zero = real(0.0)
    paw = SlidingPaw()
    paw.first = wp.normalize(wp.where(wp.abs(n[0]) < real(0.7), vec3(zero, -n[2], n[1]), vec3(n[2], zero, -n[0])))
    paw.second = wp.cross(n, paw.first)
    across = c.total * n
    along_first = c.total * paw.first
    normal_response = wp.dot(n, across)
    paw.tilt = vec2(wp.dot(across, paw.first), wp.dot(across, paw.second)) / normal_response
    first_response = wp.dot(paw.first, along_first) - normal_response * paw.tilt[0] * paw.tilt[0]
    second_response = wp.dot(paw.second, c.total * paw.second) - normal_response * paw.tilt[1] * paw.tilt[1]
    cross_response = wp.dot(paw.second, along_first) - normal_response * paw.tilt[0] * paw.tilt[1]
    paw.trace = first_response + second_response
    paw.determinant = first_response * second_response - cross_response * cross_response
    lack = c.goal - wp.dot(n, free)
    paw.size = lack / normal_response
    paw.right = -vec2(wp.dot(paw.first, free), wp.dot(paw.second, free)) - lack * paw.tilt
    paw.adjugate = vec2(
        second_response * paw.right[0] - cross_response * paw.right[1],
        first_response * paw.right[1] - cross_response * paw.right[0],
    )
    return paw


@wp.func
def sliding_impulse(c: PawContact, free: vec3) -> vec3:
    """Return the impulse [N s] of a paw that slides: on the edge of the friction cone, opposite to the slip.

    free [m/s]: velocity of the contact point without an impulse on this paw, body axes; the paw neither separates nor
    sticks. The ratio mu p_n / |t| is below 1 at s = 0 and grows without bound, so that some s is on the cone
    (`SlidingPaw`). If M is isotropic, the ratio is linear in s, and Newton's method needs few steps. A bisection
    replaces a Newton step that leaves the interval with the solution.
    """
    paw = sliding_paw(c, free)
    s = real(0.0)
    low = real(0.0)
    high = real(-1.0)  # none known
    load = real(0.0)
    along = vec2()
    steps = int(0)
    searching = bool(True)
    while searching:
        determinant = paw.determinant + s * (paw.trace + s)
        along = paw.adjugate + s * paw.right  # t times the determinant
        length = wp.length(along)
        load = paw.size * determinant - wp.dot(paw.tilt, along)  # p_n times the determinant
        excess = c.mu * load - length
        rise = c.mu * (paw.size * (paw.trace + real(2.0) * s) - wp.dot(paw.tilt, paw.right))
        slope = rise * length * length - c.mu * load * wp.dot(along, paw.right)  # of the ratio, times length^3
        load /= determinant
        steps += 1
        searching = wp.abs(excess) > SLIDE_TOLERANCE * length and steps < MAX_SLIDE_STEPS
        if excess < real(0.0):
            low = s
        else:
            high = s
        s -= excess * length * length / slope
        if not (slope > real(0.0) and s > low and (high < real(0.0) or s < high)):
            s = wp.where(high < real(0.0), real(2.0) * low + paw.trace, real(0.5) * (low + high))
    along = wp.normalize(along)
    return load * (c.normal + c.mu * (along[0] * paw.first + along[1] * paw.second))


@wp.func
def local_impulse(c: PawContact, impulse: vec3, velocity: vec3) -> vec3:
    """Return the impulse [N s] that solves one paw's contact law while the impulses of the other paws are fixed.

    impulse [N s] and velocity [m/s]: current values at this paw. A paw that could both stick and separate sticks.
    """
    n = c.normal
    stick = impulse + c.total_inv * (c.goal * n - velocity)
    normal = wp.dot(stick, n)
    tangential = stick - normal * n
    if normal > real(0.0) and wp.dot(tangential, tangential) <= c.mu * c.mu * normal * normal:
        return stick
    free = velocity - c.total * impulse
    if wp.dot(n, free) >= c.goal:
        return vec3(real(0.0))
    return sliding_impulse(c, free)


@wp.func
def push_on_block(contacts: wp.array(dtype=PawContact)) -> vec3:
    """Return the paws' total impulse [N s] on a world's sliding block (a movable box on the floor), body axes."""
    push = vec3(real(0.0))
    for k in range(contacts.shape[0]):
        if contacts[k].on_block != 0:
            push -= contacts[k].impulse
    return push


@wp.func
def block_velocity(block: BlockLaw, push: vec3) -> vec3:
    """Return the sliding block's velocity [m/s] at the end of a step, body axes; push [N s]: the paws' impulse on it.

    Coulomb friction with the floor, under the weight and the paws' load, reduces the horizontal speed, at most to 0.
    """
    upward = wp.dot(push, block.up)
    free = block.velocity + (push - upward * block.up) / block.mass
    loss = block.friction * wp.max(block.weight - upward, real(0.0)) / block.mass
    speed = wp.length(free)
    if speed <= loss:
        return vec3(real(0.0))
    return (real(1.0) - loss / speed) * free


@wp.func
def add_block(contact: PawContact, block: BlockLaw) -> PawContact:
    """Return `contact` as a contact with the sliding block, which moves under the impulse of the paw.

    `on_block` is set to 1, and the block's response is added to `total`: it slides along the floor only, so that the
    vertical direction is taken out.
    """
    c = contact
    c.on_block = 1
    c.total += (wp.identity(n=3, dtype=real) - wp.outer(block.up, block.up)) / block.mass
    c.total_inv = wp.inverse(c.total)
    return c


@wp.struct
class ContactState:
    """State of the iterative contact solver in a world: change of the base's velocity, and convergence.

    Changes are relative to the motion without contact, body axes.
    """

    lin: vec3  # change of the base's linear velocity [m/s]
    ang: vec3  # change of its angular velocity [rad/s]
    change: real  # largest velocity change of the last sweep [m/s]
    sweeps: int


@wp.func
def sweep_contacts(contacts: wp.array(dtype=PawContact), block: BlockLaw, state: ContactState) -> ContactState:
    """Run one Gauss-Seidel sweep of the contact solver over the active paws; updates their impulses in `contacts` (4,).

    Returns the new state of the iteration.
    """
    s = state
    s.change = real(0.0)
    s.sweeps = state.sweeps + 1
    for k in range(contacts.shape[0]):
        if contacts[k].active != 0:
            c = contacts[k]
            velocity = c.free + c.from_lin * s.lin + c.from_ang * s.ang + c.leg_response * c.impulse
            if c.on_block != 0:
                velocity -= block_velocity(block, push_on_block(contacts))
            impulse = local_impulse(c, c.impulse, velocity)
            step = impulse - c.impulse
            contacts[k].impulse = impulse
            s.lin += c.to_lin * step
            s.ang += c.to_ang * step
            s.change = wp.max(s.change, wp.length(c.total * step))
    return s


@wp.func
def solve_contacts(
    contacts: wp.array(dtype=PawContact), block: BlockLaw, max_sweeps: int, tolerance: real
) -> ContactState:
    """Solve the contact problem of a world's four paws by block Gauss-Seidel sweeps.

    Returns the change of the base twist and the residual. contacts (4,): impulses are the first guess and are replaced
    by the solution. Ends after `max_sweeps`, or when a sweep changes no contact velocity by more than `tolerance`
    [m/s].
    """
    state = ContactState()
    for k in range(contacts.shape[0]):
        if contacts[k].active != 0:
            state.lin += contacts[k].to_lin * contacts[k].impulse
            state.ang += contacts[k].to_ang * contacts[k].impulse
    state.change = real(2.0) * tolerance + real(1.0)
    while state.sweeps < max_sweeps and state.change > tolerance:
        state = sweep_contacts(contacts, block, state)
    return state


@wp.func
def contact_mode(impulse: vec3, normal: vec3, mu: real) -> int:
    """Classify a paw's solved contact as SEPARATE, STICK or SLIDE from its impulse [N s].

    normal: unit, out of the ground; mu: friction coefficient. Impulses within 1e-4 of the cone count as sliding, since
    the rounding errors of the solution are of this size.
    """
    size = wp.dot(impulse, normal)
    if size <= real(0.0):
        return SEPARATE
    tangential = wp.length(impulse - size * normal)
    if tangential < mu * size * real(0.9999):
        return STICK
    return SLIDE

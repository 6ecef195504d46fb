"""Arrays of the gradient of a rollout's loss w.r.t. its inputs, and functions that add to them.

`add_*` take `sums`, an array (GRADIENT_ROWS,) of one world or `ThreadSums`, and add a struct of gradients, entry by
entry, to the rows of the parameters it names; leg: 0 to 3, motor: 0 to 11. A CPU thread owns a world and sums in a
local array. On a GPU many threads share a world: they sum over their warp first, and one adds the result atomically.
A struct of gradients has the type of the parameters: its field `kp` is the gradient w.r.t. `kp`.
"""

from typing import Any

import warp as wp

from ... import layout
from ...actuation.command_filter import FilterParams, Limits
from ...actuation.joint_forces import JointParams
from ...actuation.motors import MotorParams
from ...actuation.springs import LegSpring
from ...actuation.stops import StopParams
from ...kinematics.geometry import LegGeometry
from ...lanes import sum_legs, sum_step_threads
from ...scalar import real, vec3
from ..inertia import MassMoments
from ..leg_dynamics import LegMasses
from ..trajectory import FILTER_HORIZON, FILTER_ROWS, FILTER_SPEED
from .action_gradients import LegGradient

wp.set_module_options({"enable_backward": False})

# rows of a leg's geometry: hip (3), then the lengths in the order of `LegGeometry`, without `front` and `side`
GEOMETRY_ROWS = wp.constant(10)

# rows of the gradient w.r.t. a world's parameters: first the PARAMETER_ROWS of the table of `layout`
MOTOR_GRADIENT = wp.constant(layout.PARAMETER_ROWS)  # 7 x 12: kp, kd, saturation, peak, cutoff, no_load, offset
FADE_GRADIENT = wp.constant(MOTOR_GRADIENT + 84)  # 2: start and end
LATENCY_GRADIENT = wp.constant(FADE_GRADIENT + 2)
FILTER_GRADIENT = wp.constant(LATENCY_GRADIENT + 1)
GEOMETRY_GRADIENT = wp.constant(FILTER_GRADIENT + FILTER_ROWS)  # GEOMETRY_ROWS a leg
GRADIENT_ROWS = wp.constant(GEOMETRY_GRADIENT + 40)


@wp.struct
class Gradients:
    """Gradient of one scalar per world w.r.t. all inputs of a rollout; units: the scalar's over the input's."""

    q: wp.array2d(dtype=real)  # of row 0, (ROW_COORDS, num_worlds)
    qd: wp.array2d(dtype=real)  # (ROW_RATES, num_worlds)
    target: wp.array3d(dtype=real)  # (T, 12, num_worlds)
    initial_target: wp.array3d(dtype=real)  # of `Commands.initial_target`; the caller must zero it first
    wrench: wp.array3d(dtype=real)  # (T, 6, num_worlds); the caller must zero it first
    filtered_target: wp.array3d(dtype=real)  # (T, 12, num_worlds); the caller must zero it first
    parameters: wp.array2d(dtype=real)  # (GRADIENT_ROWS, num_worlds)


@wp.struct
class ThreadSums:
    """Destination of a GPU thread's gradients w.r.t. parameters, and the threads of its warp to sum over first."""

    parameters: wp.array2d(dtype=real)  # (GRADIENT_ROWS, num_worlds)
    world: int
    weight: real  # of this thread's contribution: 1, or 0 for a repeated step
    writes: bool  # whether this thread adds the sum to `parameters`
    over_steps: bool  # whether to sum over threads with other steps of the same leg
    over_legs: bool  # whether to sum over threads with other legs


@wp.struct
class NoSums:
    """Destination of gradients w.r.t. parameters that nobody reads."""

    unused: int


@wp.func
def thread_sums(gradients: Gradients, world: int, writes: bool, over_steps: bool, over_legs: bool) -> ThreadSums:
    """Return the `ThreadSums` with which a GPU thread adds to a world's `gradients.parameters`, with weight 1.

    The caller sets the weight 0 if a thread repeats the step of another thread, only to take part in the sums of the
    warp. writes, over_steps, over_legs: see `ThreadSums`.
    """
    sums = ThreadSums()
    sums.parameters = gradients.parameters
    sums.world = world
    sums.weight = real(1.0)
    sums.writes = writes
    sums.over_steps = over_steps
    sums.over_legs = over_legs
    return sums


@wp.func
def add_entry(sums: wp.array(dtype=real), row: int, x: real):
    """Add a number to the gradient of one world w.r.t. one parameter: row `row` of `sums`, (GRADIENT_ROWS,)."""
    sums[row] = sums[row] + x


@wp.func
def add_entry(sums: ThreadSums, row: int, x: real):  # noqa: F811
    """Sum x, weighted, over threads of a warp, and add it to a world's gradient w.r.t. one parameter, atomically."""
    total = sums.weight * x
    if sums.over_steps:
        total = sum_step_threads(total)
    if sums.over_legs:
        total = sum_legs(total)
    if sums.writes:
        wp.atomic_add(sums.parameters, row, sums.world, total)


@wp.func
def add_entry(sums: NoSums, row: int, x: real):  # noqa: F811
    """Discard the gradient w.r.t. a parameter."""
    return


@wp.func
def add_vec3(sums: Any, row: int, v: vec3):
    """Add a vector to a world's gradient w.r.t. three consecutive parameters, rows from `row` on."""
    for i in range(3):
        add_entry(sums, row + i, v[i])


@wp.func
def add_moments(sums: Any, row: int, m: MassMoments):
    """Add the gradient w.r.t. a link's mass moments to a world's parameter gradient, MOMENT_ROWS rows from `row` on."""
    add_entry(sums, row, m.mass)
    add_vec3(sums, row + 1, m.first)
    for i in range(6):
        add_entry(sums, row + 4 + i, m.second[i])


@wp.func
def add_masses(sums: Any, leg: int, masses: LegMasses):
    """Add the gradient w.r.t. the mass moments of a leg's links to a world's parameter gradient."""
    row = leg * layout.LEG_ROWS
    add_moments(sums, row + layout.HOUSING, masses.housing)
    add_moments(sums, row + layout.OUTER_THIGH, masses.outer_thigh)
    add_moments(sums, row + layout.OUTER_SHANK, masses.outer_shank)
    add_moments(sums, row + layout.INNER_THIGH, masses.inner_thigh)
    add_moments(sums, row + layout.INNER_SHANK, masses.inner_shank)


@wp.func
def add_joints(sums: Any, leg: int, p: JointParams):
    """Add the gradient w.r.t. armature, friction and damping of a leg to a world's parameter gradient."""
    row = leg * layout.LEG_ROWS
    add_vec3(sums, row + layout.ARMATURE, p.armature)
    add_vec3(sums, row + layout.FRICTION, p.friction)
    add_vec3(sums, row + layout.DAMPING, p.damping)
    add_entry(sums, row + layout.KNEE_DAMPING, p.knee_damping_outer)
    add_entry(sums, row + layout.KNEE_DAMPING + 1, p.knee_damping_inner)
    add_entry(sums, row + layout.KNEE_LIMIT, p.knee_limit_outer)
    add_entry(sums, row + layout.KNEE_LIMIT + 1, p.knee_limit_inner)


@wp.func
def add_spring(sums: Any, leg: int, p: LegSpring):
    """Add the gradient w.r.t. the constants of a leg's knee spring to a world's parameter gradient."""
    row = leg * layout.LEG_ROWS + layout.SPRING
    add_entry(sums, row, p.stiffness)
    add_entry(sums, row + 1, p.length)


@wp.func
def add_stops(sums: Any, leg: int, p: StopParams):
    """Add the gradient w.r.t. the constants of a leg's hard stops to a world's parameter gradient."""
    row = leg * layout.LEG_ROWS
    add_vec3(sums, row + layout.LOWER, p.lower)
    add_vec3(sums, row + layout.UPPER, p.upper)
    add_entry(sums, row + layout.SUM_LOWER, p.sum_lower)
    add_entry(sums, row + layout.SUM_UPPER, p.sum_upper)
    add_entry(sums, row + layout.STOP_KE, p.ke)
    add_entry(sums, row + layout.STOP_KD, p.kd)


@wp.func
def add_geometry(sums: Any, leg: int, geo: LegGeometry):
    """Add the gradient w.r.t. a leg's hip position and lengths, `shank` being both shanks, to a world's gradient."""
    row = GEOMETRY_GRADIENT + leg * GEOMETRY_ROWS
    add_vec3(sums, row, geo.hip)
    add_entry(sums, row + 3, geo.outer_x)
    add_entry(sums, row + 4, geo.inner_x)
    add_entry(sums, row + 5, geo.plane_y)
    add_entry(sums, row + 6, geo.knee_y)
    add_entry(sums, row + 7, geo.thigh)
    add_entry(sums, row + 8, geo.shank + geo.outer_shank)
    add_entry(sums, row + 9, geo.paw_radius)


@wp.func
def add_leg_parameters(sums: Any, leg: int, gradient: LegGradient):
    """Add the gradient w.r.t. all constants of a leg, friction coefficients aside, to a world's parameter gradient."""
    add_geometry(sums, leg, gradient.geometry)
    add_masses(sums, leg, gradient.masses)
    add_joints(sums, leg, gradient.joints)
    add_spring(sums, leg, gradient.spring)
    add_stops(sums, leg, gradient.stops)


@wp.func
def add_com(sums: Any, mass: real, com: vec3, gradient: vec3):
    """Add the gradient w.r.t. the base's centre of mass, by the chain rule, to its mass and first moment.

    gradient: w.r.t. com [m]. mass [kg] of the base. The table has the mass and the first moment, mass * com; their
    quotient is com.
    """
    add_entry(sums, layout.BASE, -wp.dot(gradient, com) / mass)
    add_vec3(sums, layout.BASE + 1, gradient / mass)


@wp.func
def add_motor(sums: Any, shared: Any, motor: int, scale: real, p: MotorParams):
    """Add the gradient w.r.t. the constants of a motor, times `scale`, to a world's parameter gradient.

    p: that gradient; fade_start and fade_end, common to all motors, go to `shared`, the others to `sums`.
    """
    row = MOTOR_GRADIENT + motor
    add_entry(sums, row, scale * p.kp)
    add_entry(sums, row + 12, scale * p.kd)
    add_entry(sums, row + 24, scale * p.saturation)
    add_entry(sums, row + 36, scale * p.peak)
    add_entry(sums, row + 48, scale * p.cutoff_speed)
    add_entry(sums, row + 60, scale * p.no_load_speed)
    add_entry(sums, row + 72, scale * p.offset)
    add_entry(shared, FADE_GRADIENT, scale * p.fade_start)
    add_entry(shared, FADE_GRADIENT + 1, scale * p.fade_end)


@wp.func
def add_limits(sums: Any, row: int, limits: Limits):
    """Add the gradient w.r.t. the command filter's limits of one angle or sum of angles to a world's gradient.

    Rows `row` to `row` + 3 are lower, upper, lower_zone, upper_zone, as in `load_limits`. The last two stay 0: the
    filter is piecewise constant in the widths of its hard zones, in which it ignores speed (see `command_filter`).
    """
    add_entry(sums, row, limits.lower)
    add_entry(sums, row + 1, limits.upper)


@wp.func
def add_filter(sums: Any, p: FilterParams):
    """Add the gradient w.r.t. the constants of the command filter to a world's parameter gradient.

    From FILTER_GRADIENT on, the rows are in the order of `load_filter`: four rows each of lateral, transversal and sum
    (`add_limits`), then horizon and speed floor.
    """
    add_limits(sums, FILTER_GRADIENT, p.lateral)
    add_limits(sums, FILTER_GRADIENT + 4, p.transversal)
    add_limits(sums, FILTER_GRADIENT + 8, p.sum)
    add_entry(sums, FILTER_GRADIENT + FILTER_HORIZON, p.horizon)
    add_entry(sums, FILTER_GRADIENT + FILTER_SPEED, p.speed_floor)

import importlib
import math

import numpy as np
import pytest
import warp as wp

from columns import COORDS, DOFS, MOTOR_COORDS, MOTOR_DOFS
from jumper_warp.kernels.actuation import command_filter
from jumper_warp.kernels.actuation.command_filter import FilterParams, filter_leg
from jumper_warp.kernels.actuation.motors import MotorArrays, load_motor, motor_torque
from jumper_warp.kernels.scalar import real, vec3
from jumper_warp.robot.motors import (
    FilterCfg,
    LimitsCfg,
    filter_params,
    jumping_motors,
    motor_arrays,
    vertical_jump_filter,
    walking_filter,
)
from jumper_warp.sim.precision import float64_kernels

float64_kernels()
filter64 = importlib.import_module("jumper_warp.kernels_float64.actuation.command_filter")

JUMP = filter_params(vertical_jump_filter())
WALK = filter_params(walking_filter())


def safe_leg(target, pos, vel=(0.0, 0.0, 0.0), params=JUMP):
    """Return the filtered targets [deg] of one leg; vectors are lateral, outer, inner, [deg] and [deg/s]."""
    args = [vec3(*(math.radians(x) for x in values)) for values in (target, pos, vel)]
    return [math.degrees(x) for x in command_filter.filter_leg(*args, params)]


# Each case: raw target, position, velocity, expected filtered target, each (lateral, outer, inner) [deg, deg/s]. JUMP:
# lateral -15..15 (hard zones 10, 15), transversal -30..140 (10, 15), sum 0..240 (35, 45), horizon 8/60 s.
JUMP_CASES = {
    "within the limits: untouched": ((10, 100, 90), (0, 50, 50), (0, 0, 0), (10, 100, 90)),
    "far from the limits: a command beyond them is untouched": ((0, 200, 45), (0, 45, 45), (0, 300, 0), (0, 200, 45)),
    # the margin of 60 deg lasts 60/900 = 1/15 s, half the horizon: half of the 60 deg beyond 140 is removed
    "half the horizon left: half way to the limit": ((0, 200, 0), (0, 80, 0), (0, 900, 0), (0, 170, 0)),
    "a quarter of the horizon left": ((0, 200, 0), (0, 80, 0), (0, 1800, 0), (0, 155, 0)),
    "moving away from the near limit: untouched": ((0, 200, 45), (0, 80, 45), (0, -300, 0), (0, 200, 45)),
    # lower limit, -30: a margin of 40 deg at 600 deg/s lasts 1/15 s
    "lower limit, half way": ((0, -50, 90), (0, 10, 90), (0, -600, 0), (0, -40, 90)),
    # 7 deg before 140, hard zone 15, at rest
    "upper hard zone, commanded toward: clamped": ((0, 200, 20), (0, 133, 20), (0, 0, 0), (0, 140, 20)),
    "upper hard zone, commanded away: untouched": ((0, -45, 60), (0, 133, 20), (0, 900, 0), (0, -45, 60)),
    "lower hard zone, commanded toward: clamped": ((0, -60, 90), (0, -25, 90), (0, 0, 0), (0, -30, 90)),
    "lower hard zone, commanded away: untouched": ((0, 150, 60), (0, -25, 90), (0, -900, 0), (0, 150, 60)),
    "lateral upper hard zone is 15 deg": ((40, 45, 45), (1, 45, 45), (0, 0, 0), (15, 45, 45)),
    "lateral lower hard zone is 10 deg": ((-40, 45, 45), (-6, 45, 45), (0, 0, 0), (-15, 45, 45)),
    "outside above: clamped": ((0, 150, 20), (0, 145, 20), (0, -900, 0), (0, 140, 20)),
    "outside below: clamped": ((-20, 45, 45), (-16, 45, 45), (0, 0, 0), (-15, 45, 45)),
    # the sum: 230 of 240, hard zone 45; 250 commanded, so 5 deg each
    "sum, hard zone toward: both give way equally": ((0, 130, 120), (0, 120, 110), (0, 0, 0), (0, 125, 115)),
    "sum, hard zone away: untouched": ((0, 100, 110), (0, 120, 110), (0, 900, 0), (0, 100, 110)),
    # sum 0..240 with 150 at 1350 deg/s: 90/1350 = 1/15 s, half of the 40 deg above 240 is removed, 10 deg each
    "sum, half the horizon left": ((0, 140, 140), (0, 75, 75), (0, 675, 675), (0, 130, 130)),
    "sum, one thigh's speed cancels the other's": ((0, 140, 140), (0, 75, 75), (0, 675, -675), (0, 140, 140)),
    # 20 deg of sum, hard zone 35; -50 commanded, so 25 deg each; the single angles are far from their own limits
    "sum, lower hard zone": ((0, -20, -30), (0, 10, 10), (0, 0, 0), (0, 5, -5)),
    "sum outside below: clamped": ((0, -15, 5), (0, -5, -5), (0, 900, 900), (0, -10, 10)),
    # single limits first: the outer 170 -> 140, then 140 + 130 is 30 too much
    "single limits come before the sum": ((0, 170, 130), (0, 130, 105), (0, 0, 0), (0, 125, 115)),
}


@pytest.mark.parametrize("case", JUMP_CASES)
def test_jump_filter_by_hand(case):
    target, pos, vel, safe = JUMP_CASES[case]
    assert safe_leg(target, pos, vel) == pytest.approx(safe, abs=2e-4)  # [deg]


# Each case: raw target, position, velocity, expected filtered target of the outer motor [deg, deg/s]. WALK: no hard
# zones, horizon 5/60 s, so the speed floor of 60 deg/s matters within 5 deg of a limit.
WALK_CASES = {
    "slower than the floor: 2 deg at 60 deg/s last 2/5 of the horizon": (160, 138, 10, 148),
    "at rest the floor counts too": (160, 138, 0, 148),
    "faster than the floor: 10 deg at 240 deg/s last half the horizon": (160, 130, 240, 150),
    "outside the horizon": (160, 120, 240, 160),
    "no hard zone": (160, 134, 0, 160),
    "outside": (160, 141, -100, 140),
    # 37.5 deg at 900 deg/s last half the horizon: one weight holds for both limits
    "near one limit, the other binds too": (-60, 102.5, 900, -45),
}


@pytest.mark.parametrize("case", WALK_CASES)
def test_walking_filter_by_hand(case):
    target, pos, vel, safe = WALK_CASES[case]
    assert safe_leg((0, target, 0), (0, pos, 0), (0, vel, 0), WALK)[1] == pytest.approx(safe, abs=2e-4)  # [deg]


@pytest.mark.parametrize("command", [math.inf, -math.inf, 3.0e38])
@pytest.mark.parametrize("params", [JUMP, WALK], ids=["jump", "walk"])
@pytest.mark.parametrize("pos", [(0.0, 45.0, 45.0), (15.0, 140.0, 100.0), (-30.0, -90.0, 90.0)])
def test_infinite_command_becomes_finite(command, params, pos):
    assert np.all(np.abs(safe_leg((command,) * 3, pos, (0.0, 0.0, 0.0), params)) <= 720.1)  # [deg], two turns


def launch(module, target, q, qd, params, offset=None, requires_grad=False):
    """Return the filtered targets [rad] (12, num_worlds) of the kernel of `module` (single or double precision).

    target, offset [rad]: (12, num_worlds), offset None: zeros. q, qd: joint_q, joint_qd, flat over worlds.
    """
    offset = wp.zeros(target.shape, dtype=module.real, device="cpu") if offset is None else offset
    safe = wp.zeros(target.shape, dtype=module.real, device="cpu", requires_grad=requires_grad)
    dim = (4, target.shape[1])
    wp.launch(module.command_filter_kernel, dim, [0, target, q, qd, offset, params], [safe], device="cpu")
    return safe


def test_kernel_equals_filter_leg_on_sensor_readings_for_every_leg_and_world():
    num_worlds = 3
    rng = np.random.default_rng(4)
    q, qd = np.full((num_worlds, COORDS), math.nan), np.full((num_worlds, DOFS), math.nan)
    q[:, MOTOR_COORDS] = rng.uniform(-1.0, 3.0, (num_worlds, 12))
    qd[:, MOTOR_DOFS] = rng.uniform(-20.0, 20.0, (num_worlds, 12))
    target = rng.uniform(-2.0, 4.0, (12, num_worlds))
    offset = rng.uniform(-0.3, 0.3, (12, num_worlds))  # [rad] of the position sensors
    arrays = [wp.array(x, dtype=float, device="cpu") for x in (target, q.ravel(), qd.ravel(), offset)]
    safe = launch(command_filter, *arrays[:3], JUMP, arrays[3]).numpy()
    for world in range(num_worlds):
        for leg in range(4):
            rows = slice(3 * leg, 3 * leg + 3)
            pos, vel = q[world, MOTOR_COORDS][rows], qd[world, MOTOR_DOFS][rows]
            reading = vec3(*(pos + offset[rows, world]))
            expected = command_filter.filter_leg(vec3(*target[rows, world]), reading, vec3(*vel), JUMP)
            np.testing.assert_allclose(safe[rows, world], list(expected), atol=1e-5)  # [rad]


@pytest.mark.parametrize("cfg", [vertical_jump_filter(), walking_filter()], ids=["jump", "walk"])
def test_gradients_equal_central_differences(cfg):
    num_worlds, step = 64, 1.0e-7  # step: of each difference, along a random direction per input
    rng = np.random.default_rng(6)
    params = filter_params(cfg, module=filter64)
    motors = rng.uniform(-0.5, 2.4, (num_worlds, 12))
    q, qd = np.zeros((num_worlds, COORDS)), np.zeros((num_worlds, DOFS))
    q[:, MOTOR_COORDS], qd[:, MOTOR_DOFS] = motors, rng.uniform(-25.0, 25.0, (num_worlds, 12))
    values = (rng.uniform(-2.0, 4.0, (12, num_worlds)), q.ravel(), qd.ravel())
    inputs = [wp.array(x, dtype=wp.float64, device="cpu", requires_grad=True) for x in values]
    weights = rng.uniform(0.5, 1.5, (12, num_worlds))

    with wp.Tape() as tape:
        safe = launch(filter64, *inputs, params, requires_grad=True)
    tape.backward(grads={safe: wp.array(weights, dtype=wp.float64, device="cpu")})
    for name, varied, base in zip(("target", "q", "qd"), inputs, values, strict=True):
        direction = rng.normal(size=base.shape)
        sides = []
        for sign in (1.0, -1.0):
            varied.assign(base + sign * step * direction)
            sides.append(np.sum(weights * launch(filter64, *inputs, params).numpy()))
        varied.assign(base)
        numeric = (sides[0] - sides[1]) / (2.0 * step)
        assert abs(numeric) > 0.1, f"{name}: nothing to compare"
        assert np.sum(varied.grad.numpy() * direction) == pytest.approx(numeric, rel=1e-5), name


@wp.kernel(enable_backward=False)
def overshoot_kernel(
    command: wp.array2d(dtype=vec3),
    filtered: bool,
    params: FilterParams,
    motors: MotorArrays,
    inertia: real,
    overshoot: wp.array2d(dtype=real),
):
    """Write the largest overshoot [rad] (lateral, outer, inner, outer + inner; world) of one leg's joints.

    The joints are free bodies of `inertia` [kg m^2]. command [rad]: (steps, num_worlds) at 60 Hz; motors run at 480 Hz.
    """
    world = wp.tid()
    dt = real(1.0 / 480.0)
    pos, vel, over = vec3(0.0, 0.7854, 0.7854), vec3(), wp.vec4()  # start: 0, 45, 45 degrees at rest
    for step in range(command.shape[0]):
        target = command[step, world]
        if filtered:
            target = filter_leg(target, pos, vel, params)
        for _ in range(8):
            for j in range(3):
                vel[j] += dt / inertia * motor_torque(target[j], pos[j], vel[j], load_motor(motors, j, world))
            pos += dt * vel
            total = pos[1] + pos[2]
            over[0] = wp.max(over[0], wp.max(pos[0] - params.lateral.upper, params.lateral.lower - pos[0]))
            over[1] = wp.max(over[1], wp.max(pos[1] - params.transversal.upper, params.transversal.lower - pos[1]))
            over[2] = wp.max(over[2], wp.max(pos[2] - params.transversal.upper, params.transversal.lower - pos[2]))
            over[3] = wp.max(over[3], wp.max(total - params.sum.upper, params.sum.lower - total))
    for k in range(4):
        overshoot[k, world] = over[k]


# [deg] two commands of lateral, outer, inner, and bounds of the overshoot of these and of outer + inner
@pytest.mark.parametrize(
    ("low", "high", "filtered", "unfiltered"),
    [
        # largest actions: +-15 deg lateral, 45 +- 90 transversal
        ((-15.0, -45.0, -45.0), (15.0, 135.0, 135.0), [0.1, 10.0, 10.0, 20.0], [-1.0, 20.0, 20.0, 90.0]),
        ((-180.0,) * 3, (180.0,) * 3, [30.0, 21.0, 21.0, 60.0], [120.0, 120.0, 120.0, 300.0]),
    ],
    ids=["extreme actions", "beyond the limits"],
)
def test_filter_bounds_overshoot(low, high, filtered, unfiltered):
    """64 runs of 5 s in which each joint switches between the commands with probability 0.1 per policy step."""
    rng = np.random.default_rng(0)
    steps, num_worlds, ends = 300, 64, np.radians([low, high])
    side = rng.integers(0, 2, (num_worlds, 3))  # 0: low, 1: high
    commands = np.empty((steps, num_worlds, 3))
    for step in range(steps):
        side = np.where(rng.random(side.shape) < 0.1, 1 - side, side)
        commands[step] = np.take_along_axis(ends, side, axis=0)
    overshoot = wp.zeros((4, num_worlds), dtype=float, device="cpu")
    motors, worst = motor_arrays(jumping_motors(), num_worlds, device="cpu"), []
    for filters in (True, False):
        inputs = [wp.array(commands, dtype=vec3, device="cpu"), filters, JUMP, motors, 0.02]  # [kg m^2]
        wp.launch(overshoot_kernel, num_worlds, inputs, [overshoot], device="cpu")
        worst.append(np.degrees(overshoot.numpy()).max(axis=1))
    assert np.all(worst[0] < filtered) and np.all(worst[1] > unfiltered)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LimitsCfg(lower=10.0, upper=10.0), "lower limit must be below upper limit"),
        (lambda: LimitsCfg(lower=0.0, upper=10.0, lower_zone=6.0, upper_zone=6.0), "overlap"),
        (lambda: FilterCfg(LimitsCfg(0, 1), LimitsCfg(0, 1), LimitsCfg(0, 1), horizon=0.0), "horizon"),
    ],
)
def test_invalid_filter_raises_an_error_that_states_the_fault(make, message):
    with pytest.raises(ValueError, match=message):
        make()

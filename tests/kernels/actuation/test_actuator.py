import importlib
import math

import newton
import numpy as np
import pytest
import warp as wp
from newton.actuators import ClampingDCMotor, DrivePD

from columns import COORDS, DOFS, MOTOR_COORDS, MOTOR_DOFS
from jumper_warp.kernels.actuation import motors as actuator
from jumper_warp.robot.motors import MotorKindCfg, jumping_motors, motor_arrays, walking_motors
from jumper_warp.sim.precision import float64_kernels

float64_kernels()
actuator64 = importlib.import_module("jumper_warp.kernels_float64.actuation.motors")


def make_motor(**values):
    """Return `MotorParams`, by default saturated: 18 N m up to 20 rad/s, 0 at 40 rad/s, fade far above that."""
    motor = actuator.MotorParams()
    defaults = dict(kp=1.0e4, kd=0.0, saturation=18.0, peak=18.0, cutoff_speed=20.0, no_load_speed=40.0, offset=0.0)
    for name, value in (defaults | dict(fade_start=1.0e3, fade_end=2.0e3) | values).items():
        setattr(motor, name, value)
    return motor


def transversal_motor(kp=1.0e4, kd=0.0):
    """Return the robot's transversal motor with the jumping torque; kp [N m/rad], kd [N m s/rad]."""
    rpm = math.pi / 30.0
    overspeed = dict(fade_start=math.radians(2000.0), fade_end=math.radians(2500.0))
    return make_motor(kp=kp, kd=kd, cutoff_speed=225.0 * rpm, no_load_speed=382.0 * rpm, **overspeed)


def test_unsaturated_torque_is_pd_control_on_the_sensor_reading():
    motor = make_motor(kp=17.0, kd=0.8, offset=0.1)
    # 17 (0.5 - (0.2 + 0.1)) - 0.8 * 1 = 2.6 N m, for a target of 0.5 rad at 0.2 rad and 1 rad/s
    assert actuator.motor_torque(0.5, 0.2, 1.0, motor) == pytest.approx(2.6, abs=1e-6)


FAST = {"cutoff_speed": 100.0, "no_load_speed": 200.0, "fade_start": 35.0, "fade_end": 45.0}
CURVES = {  # motor, then (speed along the torque [rad/s], torque [N m])
    # 18 (40 - vel) / 20 beyond the cutoff at 20 rad/s
    "driving: flat, then linear to zero at no load": (make_motor(), [
        (0.0, 18.0), (20.0, 18.0), (25.0, 13.5), (30.0, 9.0), (40.0, 0.0), (45.0, 0.0)]),
    # the motor gives 24 (40 - v) / 20 N m beyond the cutoff: 18 at 25 rad/s
    "saturation below the peak until the envelope": (make_motor(peak=24.0), [
        (0.0, 18.0), (24.0, 18.0), (25.0, 18.0), (30.0, 12.0), (40.0, 0.0)]),
    # below cutoff, between cutoff and no load, above no load
    "braking: full torque": (make_motor(), [(-5.0, 18.0), (-30.0, 18.0), (-60.0, 18.0)]),
    # 18 (45 - vel) / (45 - 35) N m from 35 rad/s on
    "overspeed fades driving and braking alike": (make_motor(**FAST), [
        (sign * vel, torque) for vel, torque in ((35.0, 18.0), (40.0, 9.0), (44.0, 1.8), (45.0, 0.0), (50.0, 0.0))
        for sign in (1.0, -1.0)]),
    "transversal motor": (transversal_motor(), [  # cutoff 23.562, no load 40.003, fade from 34.907 to 43.633 rad/s
        (23.56, 18.0), (30.0, 18.0 * 10.0028 / 16.4410), (35.0, 18.0 * 5.0028 / 16.4410 * 8.6332 / 8.7266),
        (37.0, 18.0 * 3.0028 / 16.4410 * 6.6332 / 8.7266), (-40.0, 18.0 * 3.6332 / 8.7266)]),
}  # fmt: skip


@pytest.mark.parametrize("curve", CURVES)
def test_torque_by_hand(curve):
    motor, points = CURVES[curve]
    for vel, torque in points:
        assert actuator.motor_torque(1.0, 0.0, vel, motor) == pytest.approx(torque, abs=2e-4)
        assert actuator.motor_torque(-1.0, 0.0, -vel, motor) == pytest.approx(-torque, abs=2e-4)


def test_torque_equals_newtons_drive_and_dc_motor_below_the_overspeed_fade():
    num = 400  # independent joints, each with Newton's PD drive and DC motor, the oracle
    rng = np.random.default_rng(3)
    cutoff, no_load, saturation = 225.0 * math.pi / 30.0, 382.0 * math.pi / 30.0, 18.0
    clamping = dict(
        max_motor_effort=saturation, velocity_limit=no_load, saturation_effort=saturation / (1.0 - cutoff / no_load)
    )
    builder = newton.ModelBuilder()
    for _ in range(num):
        joint = builder.add_joint_revolute(parent=-1, child=builder.add_link(mass=1.0, inertia=wp.mat33(np.eye(3))))
        builder.add_articulation([joint])
        builder.add_actuator(DrivePD, index=joint, kp=17.0, kd=0.8, clamping=[(ClampingDCMotor, clamping)])
    model = builder.finalize(device="cpu")
    state, control = model.state(), model.control()
    # speeds at which the over-speed protection is idle: it begins at 2000 deg/s = 34.9 rad/s
    target, pos, vel = rng.uniform(-3.0, 3.0, num), rng.uniform(-3.0, 3.0, num), rng.uniform(-34.5, 34.5, num)
    control.joint_target_q.assign(target)
    state.joint_q.assign(pos)
    state.joint_qd.assign(vel)
    newton_actuator = model.actuators[0]
    newton_actuator.step(state, control, newton_actuator.state(), newton_actuator.state(), dt=1.0 / 480.0)
    expected = control.joint_f.numpy()
    assert np.sum((np.abs(expected) > 1.0) & (np.abs(expected) < 17.9)) > 50, "the oracle never left saturation"

    motor = transversal_motor(kp=17.0, kd=0.8)
    ours = [actuator.motor_torque(*map(float, args), motor) for args in zip(target, pos, vel, strict=True)]
    np.testing.assert_allclose(ours, expected, atol=2e-4)  # [N m]


def distinct_motors(num_worlds, module=actuator, requires_grad=False):
    """Return `MotorArrays` (12, num_worlds) in which every motor has its own constants, within 10 % of the robot's."""
    motors = motor_arrays(jumping_motors(), num_worlds, module=module, device="cpu", requires_grad=requires_grad)
    rng = np.random.default_rng(5)
    for name in ("kp", "kd", "saturation", "peak", "cutoff_speed", "no_load_speed"):
        array = getattr(motors, name)
        array.assign(array.numpy() * rng.uniform(0.9, 1.1, (12, num_worlds)))
    motors.offset.assign(rng.uniform(-0.1, 0.1, (12, num_worlds)))
    return motors


def test_kernel_writes_each_motors_torque_and_nothing_else():
    num_worlds = 16
    rng = np.random.default_rng(1)
    motors = distinct_motors(num_worlds)
    q, qd = rng.uniform(-1.0, 1.0, (num_worlds, COORDS)), rng.uniform(-45.0, 45.0, (num_worlds, DOFS))
    target = rng.uniform(-4.0, 4.0, (12, num_worlds))
    joint_f = wp.full(num_worlds * DOFS, 7.0, dtype=float, device="cpu")  # 7: entries that must not change
    arrays = [wp.array(x, dtype=float, device="cpu") for x in (target, q.ravel(), qd.ravel())]
    wp.launch(actuator.motor_torque_kernel, (12, num_worlds), [*arrays, motors], [joint_f], device="cpu")

    pos, vel = q[:, MOTOR_COORDS].T, qd[:, MOTOR_DOFS].T
    # the torque law of the tests above, in NumPy
    command = motors.kp.numpy() * (target - pos - motors.offset.numpy()) - motors.kd.numpy() * vel
    cutoff, no_load = motors.cutoff_speed.numpy(), motors.no_load_speed.numpy()
    slope = np.clip((no_load - np.abs(vel)) / (no_load - cutoff), 0.0, 1.0)
    available = motors.peak.numpy() * np.where(command * vel > 0.0, slope, 1.0)
    bound = np.minimum(motors.saturation.numpy(), available)
    fade = np.interp(np.abs(vel), np.radians([2000.0, 2500.0]), [1.0, 0.0])
    torque = np.clip(command, -bound, bound) * fade

    written = joint_f.numpy().reshape(num_worlds, DOFS)
    np.testing.assert_allclose(written[:, MOTOR_DOFS].T, torque, atol=1e-4)  # [N m]
    assert np.all(np.delete(written, MOTOR_DOFS, axis=1) == 7.0)


def test_gradients_equal_central_differences():
    """Gradients of a weighted sum of torques by targets, joint state and each constant of the motors."""
    num_worlds, step = 64, 1.0e-6  # step: of each difference, along a random direction per input
    rng = np.random.default_rng(2)
    motors = distinct_motors(num_worlds, actuator64, requires_grad=True)
    weights = wp.array(rng.uniform(0.5, 1.5, num_worlds * DOFS), dtype=wp.float64, device="cpu")

    def array(low, high, shape):  # uniform random values with gradients
        return wp.array(rng.uniform(low, high, shape), dtype=wp.float64, device="cpu", requires_grad=True)

    inputs = {
        "target": array(-2.5, 2.5, (12, num_worlds)),
        "q": array(-0.5, 0.5, num_worlds * COORDS),
        "qd": array(-42.0, 42.0, num_worlds * DOFS),
    }

    def torques():  # [N m] joint_f of the present inputs and motors
        joint_f = wp.zeros(num_worlds * DOFS, dtype=wp.float64, device="cpu", requires_grad=True)
        arguments = [*inputs.values(), motors]
        wp.launch(actuator64.motor_torque_kernel, (12, num_worlds), arguments, [joint_f], device="cpu")
        return joint_f

    with wp.Tape() as tape:
        joint_f = torques()
    tape.backward(grads={joint_f: weights})

    constants = ("kp", "kd", "saturation", "peak", "cutoff_speed", "no_load_speed", "offset")
    for name, varied in (inputs | {name: getattr(motors, name) for name in constants}).items():
        base, direction = varied.numpy().copy(), rng.normal(size=varied.shape)
        sides = []
        for sign in (1.0, -1.0):
            varied.assign(base + sign * step * direction)
            sides.append(np.dot(weights.numpy(), torques().numpy()))
        varied.assign(base)
        numeric = (sides[0] - sides[1]) / (2.0 * step)
        assert abs(numeric) > 1e-2, f"{name}: nothing to compare"
        assert np.sum(varied.grad.numpy() * direction) == pytest.approx(numeric, rel=1e-6), name


def test_saturation_is_clamped_to_peak_torque():
    # peak: 18 N m lateral, 24.8 N m transversal
    full = jumping_motors(24.8)
    assert (full.lateral.saturation, full.transversal.saturation) == (18.0, 24.8)
    task = jumping_motors(18.0, lateral_torque=10.0)
    assert (task.lateral.saturation, task.transversal.saturation) == (10.0, 18.0)


def test_arrays_repeat_lateral_and_transversal_constants():
    motors = motor_arrays(walking_motors(), 2, device="cpu")  # rows lateral, outer, inner of each leg; 2 worlds
    np.testing.assert_allclose(motors.kd.numpy(), np.tile([[2.07], [0.92], [0.92]], (4, 2)), rtol=1e-6)
    np.testing.assert_allclose(motors.saturation.numpy(), np.full((12, 2), 10.0))  # [N m]
    np.testing.assert_allclose(motors.no_load_speed.numpy()[:3, 1], [49.218, 40.003, 40.003], atol=1e-3)  # 470, 382 rpm
    assert motors.fade_start == pytest.approx(34.9066, abs=1e-4)  # 2000 deg/s


VALID_KIND = dict(kp=17.0, kd=0.8, saturation=18.0, peak=24.8, cutoff_speed=20.0, no_load_speed=40.0)


@pytest.mark.parametrize(("name", "value"), [("saturation", 0.0), ("kp", math.nan), ("no_load_speed", 20.0)])
def test_motor_constant_out_of_range_raises_an_error_that_names_it(name, value):
    with pytest.raises(ValueError, match=name):
        MotorKindCfg(**(VALID_KIND | {name: value}))

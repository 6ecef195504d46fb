"""Filter, position control and frames of the runtime against the simulation's, bit for bit."""

from dataclasses import replace

import numpy as np
import pytest

from jumper_warp.deploy.control import Gains, clip_target, motor_torque
from jumper_warp.robot.motors import (
    horizontal_jump_filter,
    jumping_motors,
    vertical_jump_filter,
    walking_filter,
    walking_motors,
)
from jumper_warp.sim.simulation import Simulation, motor_values

AHEAD = horizontal_jump_filter()
SETTINGS = {
    "vertical_jump": (jumping_motors(18.0, lateral_torque=10.0), vertical_jump_filter()),
    "horizontal_jump": (
        jumping_motors(18.0, lateral_torque=12.0),
        replace(AHEAD, transversal=replace(AHEAD.transversal, upper=110.0)),
    ),
    "walking": (walking_motors(), walking_filter()),
}
WORLDS, STEPS = 50, 72  # 3,600 recorded steps of each policy, 10,800 of all


@pytest.fixture(scope="module")
def recordings():
    """Recorded steps by policy: angle, rate, action's target, filtered target and torque, (steps, 12) each."""
    result = {}
    for name, (motors, command_filter) in SETTINGS.items():
        sim = Simulation(WORLDS, motors=motors, command_filter=command_filter, substeps=1, visuals=False, device="cpu")
        rng = np.random.default_rng(0)
        rows = []
        for step in range(STEPS):
            if step % 8 == 0:
                target = rng.uniform(-1.0, 2.5, (12, WORLDS)).astype(np.float32)
                sim.set_targets(target)
            state = [motor_values(values).copy() for values in (sim.joint_q()[:, 7:], sim.joint_qd()[:, 6:])]
            sim.step()
            rows.append([*state, target.T, sim._safe_target.numpy().T.copy(), sim.torque.numpy().T.copy()])
        result[name] = [np.concatenate(each) for each in zip(*rows, strict=True)]
    return result


@pytest.mark.parametrize("name", SETTINGS)
def test_filter_torque_and_frames_are_bitwise_those_of_the_simulation(name, recordings, bundle):
    angle, rate, target, filtered, torque = recordings[name]
    policy = bundle.policies[name]
    gains = Gains.from_yaml(bundle.settings["policies"][name])
    ours = np.array([policy.filter_targets(*row) for row in zip(target, angle, rate, strict=True)])
    assert len(ours) == WORLDS * STEPS and ours.dtype == np.float32
    assert (ours == filtered).all()
    assert (motor_torque(ours, angle, rate, gains, bundle.curve) == torque).all()
    for row in range(0, len(ours), 50):
        expected = bundle.joints.frames(filtered[row], gains.kp, gains.kd)
        assert (bundle.joints.frames(ours[row], gains.kp, gains.kd) == expected).all()


@pytest.mark.parametrize("name", SETTINGS)
def test_clipped_targets_ask_no_motor_for_more_than_its_limit(name, recordings, bundle):
    angle, rate, _, filtered, _ = recordings[name]
    gains = Gains.from_yaml(bundle.settings["policies"][name])
    clipped = clip_target(filtered, angle, rate, gains)
    asked = gains.kp * (clipped - angle) - gains.kd * rate
    assert (np.abs(asked) <= gains.limit * (1.0 + 1e-5)).all()
    free = np.abs(gains.kp * (filtered - angle) - gains.kd * rate) < gains.limit
    assert np.abs(clipped - filtered)[free].max() < 1e-5

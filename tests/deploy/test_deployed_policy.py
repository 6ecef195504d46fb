"""`DeployedPolicy` against the environment of `jumper evaluate`, and in programs with mistakes."""

import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx.external_data_helper import convert_model_to_external_data

from columns import ANG_VEL, QUAT, XY, X, Y, Z
from jumper_warp.deploy.policy import DeployedPolicy, JumpCommand
from jumper_warp.evaluation.conditions import Conditions, env_of_recipe
from jumper_warp.kernels.jump.state import LANDED
from jumper_warp.policies.catalog import find_policy
from jumper_warp.policies.policy import export_onnx, load_policy
from jumper_warp.policies.spec import checksum_entry
from jumper_warp.robot.motors import jumping_motors
from jumper_warp.sim.simulation import Simulation, motor_values
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.rotations import CONJUGATE, rotate

pytestmark = pytest.mark.usefixtures("one_thread")
ROOT = Path(__file__).resolve().parents[2]
TUTORIAL = ROOT / "docs" / "tutorials" / "on_a_robot.md"
COMMAND_STEP, HEIGHT = 30, 0.9  # policy step of the command to jump; commanded base height [m]


def onnx_of(name):
    """Return the `DeployedPolicy` of a shipped policy."""
    return DeployedPolicy(find_policy(name) / "policy.onnx")


def robot_readings(robot):
    """Return the readings of a simulated robot that every policy takes."""
    q, qd = robot.joint_q()[0], robot.joint_qd()[0]
    to_body = q[QUAT] * CONJUGATE
    return {
        "height": q[Z],
        "lin_vel": rotate(to_body, robot.base_velocity()[0]),
        "ang_vel": rotate(to_body, qd[ANG_VEL]),
        "gravity": rotate(to_body, np.array([0.0, 0.0, -1.0])),
        "angle": motor_values(q[7:]),
        "rate": motor_values(qd[6:]),
    }


def paws_down(robot):
    """Return the number of paws on the ground."""
    return int((np.linalg.norm(robot.paw_force.numpy()[:, 0], axis=-1) > 0.1).sum())  # [N]


def way_to(place, robot):
    """Return the way from the base to a position in the world [m], ahead and to the left."""
    q = robot.joint_q()[0]
    ahead = rotate(q[QUAT], np.array([1.0, 0.0, 0.0]))
    yaw = np.arctan2(ahead[Y], ahead[X])
    x, y = place - q[XY]
    return np.array([np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x])


@pytest.fixture(scope="module")
def environment_apex():
    """Apex [m] of the policy's jump to HEIGHT in the environment."""
    policy = load_policy("vertical_jump")
    env = env_of_recipe(policy.recipe(), 1, Conditions(device="cpu"))
    env.evaluation_reset([[0.0, 0.0, HEIGHT, COMMAND_STEP]])
    heights = []
    for _ in range(120):
        env.step(policy.act(env.obs))
        heights.append(env.sim.joint_q()[0, Z])
    return max(heights)


def test_jump_to_a_height_is_that_of_the_environment(environment_apex):
    apex, _ = jump()
    assert apex == pytest.approx(environment_apex, abs=0.004)  # [m]; 0.877


@pytest.mark.parametrize(
    ("name", "goal", "heading"),  # goal: position and height [m], heading [rad]
    [("vertical_jump", (0.0, 0.0, 0.9), 0.5), ("horizontal_jump", (0.8, 0.2, 0.0), 1.0)],
)
def test_observations_actions_and_targets_agree_with_the_environment(name, goal, heading):
    """The environment's policy drives one robot through a jump, whose readings the deployed policy gets each step."""
    policy, deployed, command = load_policy(name), onnx_of(name), JumpCommand()
    env = env_of_recipe(policy.recipe(), 1, Conditions(device="cpu"))
    env.evaluation_reset([[*goal, COMMAND_STEP]], heading)
    goal_position = env.task_arrays()["goal"][0, XY]
    errors, frame_difference = np.zeros(3), 0.0
    for tick in range(150):
        readings = robot_readings(env.sim)
        velocity = env.sim.base_velocity()[0]
        if tick == COMMAND_STEP:
            command.request()
        jump_command = command.update(velocity[Z], paws_down(env.sim))
        to_goal = way_to(goal_position, env.sim) if tick >= COMMAND_STEP else np.zeros(2)
        task_readings = {"wanted_height": goal[Z], "jump_command": jump_command} if goal[Z] else {"goal": to_goal}
        obs = deployed.observe(readings | task_readings)
        action, expected = deployed.act(obs), policy.act(env.obs)
        target = deployed.default + deployed.scale * action
        filtered = deployed.filter_targets(target, readings["angle"], readings["rate"])
        env_obs = env.obs[0].numpy().copy()
        frame_difference = max(frame_difference, np.abs(velocity - env_obs[12:15]).max())  # newest lin_vel, body axes
        env.step(expected)
        assert deployed.action is action  # the last action of the next observation
        deployed.action = expected[0].numpy()  # else the policy may amplify differences of its last actions
        env_target = env.robot.filtered_target.numpy()[:, 0]
        pairs = ((obs, env_obs), (action, expected[0].numpy()), (filtered, env_target))
        errors = np.maximum(errors, [np.abs(a - b).max() for a, b in pairs])
    assert env.task_arrays()["phase"][0] == LANDED and (command.requested, command.in_flight) == (False, False)
    assert errors.max() < 3.0e-5, errors  # [SI]; rounding of body axes in float32 and of ONNX's sums
    assert frame_difference > 0.05  # [m/s] so large that world axes would exceed the tolerance


def jump(delay=0, ticks=180):
    """Return apex [m] and number of takeoffs of a vertical jump commanded to HEIGHT.

    delay: policy steps by which the end of the jump command is delayed; ticks: policy steps to simulate.
    """
    policy, command = onnx_of("vertical_jump"), JumpCommand()
    robot = Simulation(1, motors=jumping_motors(18.0, lateral_torque=10.0), friction=0.85, device="cpu")
    apex, takeoffs, in_flight, commands = 0.0, 0, False, []
    for tick in range(ticks):
        if tick == COMMAND_STEP:
            command.request()
        up, down = robot.base_velocity()[0, Z], paws_down(robot)
        commands.append(command.update(up, down))
        task_readings = {"wanted_height": HEIGHT, "jump_command": max(commands[-1 - delay :])}
        robot.set_targets(policy.targets(robot_readings(robot) | task_readings))
        robot.step()
        takeoff = not in_flight and down == 0 and up > 0.75  # [m/s]
        in_flight, takeoffs = down == 0 and (in_flight or takeoff), takeoffs + takeoff
        apex = max(apex, robot.joint_q()[0, Z])
    return apex, takeoffs


def test_short_delay_of_the_commands_end_keeps_apex_and_one_takeoff(environment_apex):
    apex, takeoffs = jump(delay=9, ticks=480)  # policy steps of 1/60 s
    assert apex == pytest.approx(environment_apex, abs=0.005) and takeoffs == 1


def test_history_starts_with_the_first_reading_and_shifts_each_step():
    policy = onnx_of("vertical_jump")
    readings = {
        "wanted_height": 0.9, "jump_command": 0.0, "height": 0.3, "lin_vel": [1.0, 2.0, 3.0], "ang_vel": np.zeros(3),
        "gravity": [0.0, 0.0, -1.0], "angle": policy.default, "rate": np.zeros(12),
    }  # fmt: skip
    lin_vel, last_action = slice(3, 15), slice(99, 147)  # columns, 4 frames each
    np.testing.assert_array_equal(policy.observe(readings)[lin_vel], [1.0, 2.0, 3.0] * 4)
    policy.act(policy.observe(readings | {"lin_vel": [4.0, 5.0, 6.0]}))
    obs = policy.observe(readings | {"lin_vel": [7.0, 8.0, 9.0]})
    np.testing.assert_array_equal(obs[lin_vel], [1.0, 2.0, 3.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0])
    np.testing.assert_array_equal(obs[last_action], [*np.zeros(36), *policy.action])  # the newest frame of 12 is last
    policy.reset()
    np.testing.assert_array_equal(policy.observe(readings)[last_action], np.zeros(48))


def zero_readings(policy):
    """Return readings of zero for all terms of a policy's observation, but gravity along -z."""
    widths = {name: (term["end"] - term["first"]) // term["history"] for name, term in policy.layout.items()}
    readings = {name: np.zeros(width) for name, width in widths.items() if name != "last_action"}
    return readings | ({"gravity": [0.0, 0.0, -1.0]} if "gravity" in readings else {})


@pytest.mark.parametrize("value", [math.nan, 1e39])
def test_refuses_a_reading_that_is_not_finite_and_continues_with_the_next(value):
    policy, faultless = onnx_of("vertical_jump"), onnx_of("vertical_jump")
    readings = zero_readings(policy)
    first = policy.targets(readings)
    np.testing.assert_array_equal(faultless.targets(readings), first)
    for name, reading in readings.items():
        faulty = np.array(reading)
        faulty[-1] = value
        with pytest.raises(InputError, match=f"^{name} is not finite: .*; hold the last target$"):
            policy.targets(readings | {name: faulty})
    np.testing.assert_array_equal(policy.targets(readings), faultless.targets(readings))


WRONG_READINGS = [
    ({"angle": np.degrees(np.tile([0.0, 0.8, 0.8], 4))}, r"angle must be within ±3.142 rad, got 45.84; hold the last"),
    ({"height": 1e30}, r"height must be within ±10 m, got 1e\+30; hold the last"),
    ({"gravity": [0.0, 0.0, -9.81]}, "gravity must be a unit vector, got length 9.81; hold the last"),
    ({"angle": np.zeros(12, dtype="datetime64[s]")}, "angle must be numbers"),
    ({"jump_comand": 1.0}, "readings missing or unknown: jump_comand"),
    ({"lin_vel": np.zeros(2)}, r"lin_vel must have 3 values, got shape \(2,\)"),
]


@pytest.mark.parametrize(("change", "message"), WRONG_READINGS)
def test_refuses_wrong_readings_and_keeps_the_history(change, message):
    policy, faultless = onnx_of("vertical_jump"), onnx_of("vertical_jump")
    readings = zero_readings(policy)
    with pytest.raises(InputError, match=message):
        policy.targets(readings | change)
    np.testing.assert_array_equal(policy.targets(readings), faultless.targets(readings))


def test_refuses_weights_in_another_file_than_the_checksum_covers(tmp_path, monkeypatch):
    model = onnx.load(find_policy("vertical_jump") / "policy.onnx")
    convert_model_to_external_data(model, location="weights.bin", size_threshold=1024)
    onnx.save(model, tmp_path / "policy.onnx")
    data = (tmp_path / "policy.onnx").read_bytes()
    (tmp_path / "policy.onnx").write_bytes(data + checksum_entry(data))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"policy\.onnx: takes weights from another file"):
        DeployedPolicy("policy.onnx")


@pytest.mark.parametrize(
    ("speed", "values"), [(math.nan, (0.0, 4)), ("x", (0.0, 4)), (0.75, (1.0e30, 4)), (0.75, (0.0, 5))]
)
def test_jump_command_refuses_implausible_values(speed, values):  # vertical velocity [m/s], paws down
    with pytest.raises(InputError, match=r"takeoff_speed must be|vertical_velocity must be|paws_down must be"):
        JumpCommand(speed).update(*values)


def test_exported_file_has_its_checksum_and_the_weights_of_the_policy(tmp_path):
    path = export_onnx(load_policy("walking"), tmp_path / "walk.onnx")
    onnx.checker.check_model(onnx.load(path), full_check=True)
    exported, shipped = DeployedPolicy(path), onnx_of("walking")
    readings = zero_readings(shipped)
    np.testing.assert_array_equal(exported.targets(readings), shipped.targets(readings))
    assert exported.interface == shipped.interface


def test_files_named_in_the_tutorial_suffice_on_the_robot(tmp_path):
    files = re.findall(r"`(jumper_warp/\S+\.py)`", TUTORIAL.read_text(encoding="utf-8"))
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / file, tmp_path / file)
    policy = find_policy("vertical_jump") / "policy.onnx"
    code = f"from jumper_warp.deploy import policy\nprint(policy.DeployedPolicy({str(policy)!r}).default[1])"
    settings = {"cwd": tmp_path, "env": os.environ | {"PYTHONPATH": str(tmp_path)}, "capture_output": True}
    answer = subprocess.run([sys.executable, "-c", code], **settings, text=True)
    assert answer.returncode == 0, answer.stderr
    assert float(answer.stdout) == pytest.approx(math.radians(45.0))


def test_jump_command_ends_with_the_landing():
    command = JumpCommand(takeoff_speed=0.75)
    command.request()
    # (vertical velocity [m/s], paws down): standing, too slow, a paw down, takeoff, still pushing off, flight, landing,
    # next flight
    steps = [(0.0, 4), (0.7, 0), (0.8, 1), (0.8, 0), (0.9, 2), (-1.0, 0), (-1.0, 1), (0.9, 0)]
    assert [command.update(*step) for step in steps] == [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0]

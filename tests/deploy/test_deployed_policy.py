"""Policies without the environment: the page's examples, against the environment that `jumper evaluate` uses."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jumper_warp.deploy.policy import DeployedPolicy, JumpCommand
from jumper_warp.policies.conditions import Conditions, env_of_policy
from jumper_warp.policies.folder import find_policy, load_policy

pytestmark = pytest.mark.usefixtures("one_thread")
PAGE = Path(__file__).parents[2] / "docs" / "deployment.md"
COMMAND_STEP = 30


def without_past(policy, readings):
    policy._frames.clear()
    return readings


def without_filter(policy, readings):
    policy.filtered = lambda target, angle, rate: target
    return readings


MISTAKES = {
    "no default pose": (lambda policy, r: r | {"angle": r["angle"] + policy.default}, 0.920),
    "default pose twice": (lambda policy, r: r | {"angle": r["angle"] - policy.default}, 0.392),
    "no past": (without_past, 0.814),
    "gravity upward": (lambda policy, r: r | {"gravity": -r["gravity"]}, 0.872),
    "gravity times 9.81": (lambda policy, r: r | {"gravity": 9.81 * r["gravity"]}, 0.949),
    "no filter": (without_filter, 0.904),
}
"""What a program can get wrong, and the apex [m] that the page tells of it."""


def onnx_of(name):
    return DeployedPolicy(find_policy(name) / "policy.onnx")


@pytest.fixture(scope="module")
def page():
    """Names that the page's code leaves, and what it prints."""
    names, printed = {"print": lambda *values: printed.append(" ".join(map(str, values)))}, []
    for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL):
        exec(block, names)
    return names | {"printed": printed}


def test_the_examples_jump_up_and_ahead(page):
    assert page["apex"] == pytest.approx(0.9, abs=0.005)
    assert page["printed"][0] == "apex 0.900 m"
    assert np.linalg.norm(page["robot"].joint_q()[0, :2] - page["place"]) < 0.03


def test_the_example_shows_the_interface(page):
    assert page["printed"][-8:] == [
        "goal 0 2 1", "height 2 3 1", "lin_vel 3 15 4", "ang_vel 15 27 4", "gravity 27 39 4", "angle 39 87 4",
        "rate 87 99 1", "last_action 99 147 4",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "goal", "heading"), [("vertical_jump", (0.0, 0.0, 0.9), 0.5), ("horizontal_jump", (0.8, 0.2, 0.0), 1.0)]
)
def test_observations_actions_and_targets_are_those_of_the_environment(page, name, goal, heading):
    policy, deployed, command = load_policy(name), onnx_of(name), JumpCommand()
    env = env_of_policy(policy, 1, Conditions(device="cpu"))
    env.evaluation_reset([[*goal, COMMAND_STEP]], heading)
    place = env.task_arrays()["goal"][0, :2]
    off, wrong = np.zeros(3), 0.0
    for tick in range(150):
        readings = page["readings"](env.sim)
        velocity = env.sim.base_velocity()[0]
        if tick == COMMAND_STEP:
            command.give()
        asked = command.update(velocity[2], page["paws_down"](env.sim))
        way = page["way_to"](place, env.sim) if tick >= COMMAND_STEP else np.zeros(2)
        given = {"wanted_height": goal[2], "jump_command": asked} if goal[2] else {"goal": way}
        seen = deployed.observe(readings | given)
        action, expected = deployed.act(seen), policy.act(env.obs)
        safe = deployed.filtered(deployed.default + deployed.scale * action, readings["angle"], readings["rate"])
        own = env.obs[0].numpy().copy()
        wrong = max(wrong, np.abs(velocity - own[12:15]).max())
        env.step(expected)
        assert deployed.action is action  # what it will see as its last
        deployed.action = expected[0].numpy()  # in flight a policy may make more of what its last actions were off by
        theirs = env.robot.filtered_target.numpy()[:, 0]
        pairs = ((seen, own), (action, expected[0].numpy()), (safe, theirs))
        off = np.maximum(off, [np.abs(a - b).max() for a, b in pairs])
    assert env.task_arrays()["phase"][0] == 2 and (command.wanted, command.in_flight) == (False, False)
    assert off.max() < 3.0e-5, off  # [SI]; rounding: body axes in single precision, ONNX's sums
    assert wrong > 0.05  # velocities in world axes would have been seen


def jump(page, change=None, late=0, ticks=180):
    """Return apex [m] and number of takeoffs of the page's jump.

    change: of policy and readings, returns what is read instead; late: policy steps that the command drops late.
    """
    policy, command = onnx_of("vertical_jump"), JumpCommand()
    robot = page["Simulation"](1, motors=page["jumping_motors"](18.0, lateral_torque=10.0), friction=0.85, device="cpu")
    apex, takeoffs, flying, asked = 0.0, 0, False, []
    for tick in range(ticks):
        if tick == COMMAND_STEP:
            command.give()
        up, down = robot.base_velocity()[0, 2], page["paws_down"](robot)
        asked.append(command.update(up, down))
        readings = page["readings"](robot)
        if change is not None:
            readings = change(policy, readings)
        given = {"wanted_height": 0.9, "jump_command": max(asked[-1 - late :])}
        robot.set_targets(policy.targets(readings | given))
        robot.step()
        began = not flying and down == 0 and up > 0.75
        flying, takeoffs = down == 0 and (flying or began), takeoffs + began
        apex = max(apex, robot.joint_q()[0, 2])
    return apex, takeoffs


@pytest.mark.parametrize("mistake", MISTAKES)
def test_what_mistakes_come_to(page, mistake):
    change, apex = MISTAKES[mistake]
    assert jump(page, change)[0] == pytest.approx(apex, abs=0.02)


def test_a_command_that_drops_a_little_late_changes_nothing(page):
    apex, takeoffs = jump(page, late=9, ticks=480)
    assert apex == pytest.approx(0.9, abs=0.005) and takeoffs == 1


@pytest.mark.parametrize(("late", "takeoffs"), [(12, 2), (480, 8)])  # 3 and 9 where the page's figures were made
def test_a_command_that_stays_makes_the_robot_jump_again(page, late, takeoffs):
    assert jump(page, late=late, ticks=480)[1] >= takeoffs


def test_history_begins_with_the_first_reading_and_moves_on(page):
    policy = onnx_of("vertical_jump")
    readings = {
        "wanted_height": 0.9, "jump_command": 0.0, "height": 0.3, "lin_vel": [1.0, 2.0, 3.0], "ang_vel": np.zeros(3),
        "gravity": [0.0, 0.0, -1.0], "angle": policy.default, "rate": np.zeros(12),
    }  # fmt: skip
    np.testing.assert_array_equal(policy.observe(readings)[3:15], [1.0, 2.0, 3.0] * 4)
    policy.act(policy.observe(readings | {"lin_vel": [4.0, 5.0, 6.0]}))
    seen = policy.observe(readings | {"lin_vel": [7.0, 8.0, 9.0]})
    np.testing.assert_array_equal(seen[3:15], [1.0, 2.0, 3.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0])
    np.testing.assert_array_equal(seen[99:147], [*np.zeros(36), *policy.action])
    policy.reset()
    np.testing.assert_array_equal(policy.observe(readings)[99:147], np.zeros(48))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"jump_comand": 1.0}, "readings missing or unknown: jump_comand"),
        ({"last_action": np.zeros(12)}, "readings missing or unknown: last_action"),
        ({"lin_vel": np.zeros(2)}, r"lin_vel takes 3 numbers, got an array of shape \(2,\)"),
    ],
)
def test_readings_that_do_not_fit_are_refused(change, message):
    policy = onnx_of("vertical_jump")
    terms = {n: np.zeros((t["end"] - t["first"]) // t["history"]) for n, t in policy.layout.items()}
    del terms["last_action"]
    with pytest.raises(ValueError, match=message):
        policy.observe(terms | change)


def test_a_command_given_before_it_landed_ends_with_the_landing():
    command = JumpCommand()
    command.give()
    steps = [(0.0, 4), (0.7, 0), (0.8, 1), (0.8, 0), (-1.0, 0), (-1.0, 1), (0.9, 0)]
    assert [command.update(*step) for step in steps] == [1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0]


@pytest.mark.parametrize("module", ["deploy.policy", "policies.spec"])
def test_it_needs_neither_pytorch_nor_warp(module):
    code = f"import sys, jumper_warp.{module}\nprint([m for m in ('torch', 'warp', 'newton') if m in sys.modules])"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"

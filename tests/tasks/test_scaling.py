"""Tasks in the measures of a robot: the Jumper's numbers stay, those of other robots follow from their sizes."""

import math
import re
from dataclasses import replace

import pytest

from jumper_warp.registry import TASKS, make_task
from jumper_warp.robot.overlay import RobotOverlay, load_overlay
from jumper_warp.sim.apex import OpenLoopJump, jumper_measures, measure
from jumper_warp.tasks.scaling import scaled


@pytest.mark.parametrize("name", TASKS)
def test_numbers_of_the_jumper_stay_bitwise(name):
    task = make_task(name)
    again = scaled(task, RobotOverlay({}).description, jumper_measures(), jumper_measures())
    assert again == task and repr(again) == repr(task)


def test_jumper_reaches_the_height_that_tasks_assume():
    assert OpenLoopJump(RobotOverlay({})).run() == pytest.approx(jumper_measures().apex, abs=2.0e-4)


def test_vertical_jump_of_a_heavy_robot_by_hand():
    robot = load_overlay("heavy")
    task, usual, ours = make_task("vertical-jump", robot), make_task("vertical-jump"), measure(robot)
    gain = (ours.apex - ours.height) / (jumper_measures().apex - jumper_measures().height)
    top = task.levels[-1].goal_upper[2]
    assert top == pytest.approx(ours.height + gain * (1.15 - jumper_measures().height))
    low = ours.height / jumper_measures().height
    assert task.levels[0].base_height == pytest.approx((0.22 * low, 0.35 * low))
    terms = {term.name: term for term in (*task.rewards, *task.terminations)}
    assert terms["ground_force"].numbers["weight_force"] == pytest.approx(40.0 * 9.81)
    assert terms["low_base"].numbers["height"] == pytest.approx(0.10 * low)
    torque = 0.5 * (95.7793 + 86.2014)
    assert terms["motor_torque_sq"].weight == pytest.approx(-5.0e-4 * (24.8 / torque) ** 2)
    assert task.motors.transversal.saturation == pytest.approx(18.0 / 24.8 * 95.7793)
    assert task.advance.numbers["takeoff_speed"] == pytest.approx(0.75 * math.sqrt(0.695 / 0.475))
    assert terms["tilted"] == {term.name: term for term in usual.terminations}["tilted"]


def test_squat_of_a_heavy_robot_is_in_its_measures():
    robot = load_overlay("heavy")
    ours, usual = measure(robot), jumper_measures()
    low, gain = ours.height / usual.height, (ours.apex - ours.height) / (usual.apex - usual.height)
    task = make_task("vertical-jump-standing", robot)
    squat, end = (next(t for t in terms if t.name == name) for terms, name in (
        (task.rewards, "squat"), (task.terminations, "shallow_squat")))  # fmt: skip
    numbers = {"takeoff_height": 0.31 * low, "floor": 0.15 * low, "acceleration": 50.0 * gain / low}
    assert squat.numbers | numbers == pytest.approx(squat.numbers) and end.numbers | numbers == pytest.approx(
        end.numbers
    )
    # a way to push as long for the robot's height as the Jumper's: way = rise g / a
    assert gain * 0.7 * 9.81 / squat.numbers["acceleration"] / ours.height == pytest.approx(
        0.7 * 9.81 / 50 / usual.height
    )
    assert (squat.numbers["std"], end.numbers["tolerance"]) == pytest.approx((0.03 * low, 0.04 * low))


def test_lengths_and_speeds_of_a_small_robots_rewards_are_below_the_jumpers():
    names = {
        "horizontal-jump-paper": {"tracking": ["std"], "estimated_tracking": ["std", "std_wide"]},
        "vertical-jump-paper": {"jump_height": ["std", "scale"], "estimated_jump_height": ["std", "scale"]},
        "horizontal-jump-standing": {"settled": ["std"], "base_at_rest": ["std_lin_vel"]},
    }
    for task, terms in names.items():
        small, usual = (make_task(task, robot).rewards for robot in (load_overlay("small_direct_drive"), None))
        for ours, theirs in zip(small, usual, strict=True):
            for name in terms.get(ours.name, []):
                ratio = ours.numbers[name] / theirs.numbers[name]
                assert ratio == pytest.approx(0.726 if task.endswith("standing") else 0.698, abs=0.001), ours.name
    smallest = [make_task("velocity-paper", robot).levels[0].smallest for robot in (load_overlay("heavy"), None)]
    assert smallest[0] / smallest[1] == pytest.approx(1.21, abs=0.01)


KEPT = {
    "angle", "duty", "fine_weight", "first", "flight", "fraction", "idle_steps", "landing_steps", "last", "rotation",
    "settle", "shift", "stance", "start_steps", "std_ang_vel", "std_lateral", "std_posture", "std_variance",
    "steepness", "steps", "waiting_scale", "weight", "yaw",
}  # fmt: skip
"""Names of numbers that are no lengths or speeds, at least in some terms."""
KEPT_OF_TERM = {
    "std": r"(\w+_)?(posture|angular_velocity|orientation|orientation_error|yaw_rate|yaw_rate_fine|symmetry|hold)"
           r"|attitude_\w+",
    "threshold": "(clamped_)?rapid_stepping|shank_lean",  # numbers of touchdowns, an angle
    "limit": "clamped_rapid_stepping|soft_impact|stance_impact",  # a number, accelerations
}  # fmt: skip
"""Terms in which numbers of these names are no lengths or speeds, as regular expressions."""


@pytest.mark.parametrize("task", [name for name, entry in TASKS.items() if entry.of_project])
def test_terms_of_another_robot_have_its_lengths(task):
    ours, theirs = (make_task(task, robot) for robot in (load_overlay("heavy"), None))
    for terms in ("rewards", "terminations"):
        for our, their in zip(getattr(ours, terms), getattr(theirs, terms), strict=True):
            kept = {name for name, number in our.numbers.items() if number and number == their.numbers[name]}
            assert all(re.fullmatch(KEPT_OF_TERM.get(name, ""), our.name) for name in kept - KEPT), our.name


def test_robot_without_lateral_axis_starts_level_and_walks_ahead_and_back_only():
    task = make_task("velocity-flat", load_overlay("small_direct_drive"))
    settings = task.reset.settings
    assert settings.tilt == 0.0 and settings.front_y[0] == settings.front_y[1] == pytest.approx(0.11)
    assert 0.5 < task.evaluation.max_velocity[0] < 0.65 and max(task.evaluation.max_velocity[1:]) < 0.01
    ahead, back, aside, turning = task.levels[0].last_range
    assert min(ahead, back) > 1.0 and max(aside, turning) < 0.01
    assert task.command_filter.lateral.upper == 0.01
    for level in make_task("horizontal-jump", load_overlay("small_direct_drive")).levels:
        assert level.goal_lower[1] == level.goal_upper[1] == 0.0


def test_starts_stay_within_the_stops_of_the_robot():
    jumper, task = RobotOverlay({}).description, make_task("horizontal-jump-standing")
    stop = math.radians(120.0)
    joints = tuple(replace(joint, upper=min(joint.upper, stop)) for joint in jumper.joints)
    stiff = scaled(task, replace(jumper, joints=joints), jumper_measures(), jumper_measures())
    limits = stiff.reset.settings.transversal_limit, stiff.command_filter.transversal.upper
    assert limits == pytest.approx((110.0, 90.0))  # as far from the stops as the Jumper's
    assert (task.reset.settings.transversal_limit, task.command_filter.transversal.upper) == (130.0, 110.0)

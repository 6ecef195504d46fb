"""Randomisation around a robot overlay: samples of many worlds, the report of the ranges, and flags of a training."""

import json
from dataclasses import replace

import numpy as np
import pytest

from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.registry import make_task
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.robot.values import PAW_FRICTION, RobotValues
from jumper_warp.tasks.overlay_ranges import range_words
from jumper_warp.tasks.randomization import RandomizationCfg
from randomization_helpers import HELD, OFF, fills, randomized, read

WORLDS, STEP_MS = 512, 1000.0 / 480.0  # Number of robots; physics step [ms]
CFG = RandomizationCfg(observation_latency=(0.0, 16.0), **HELD)
BY_MOTOR = tuple(0.04 + 0.005 * motor for motor in range(12))  # [N m]
VALUES = {
    "base_mass": (8.0,), "base_com": (0.02, 0.01, 0.03), "base_inertia": (1.2,), "link_mass": (1.1, 1.2, 0.9, 1.0, 0.8),
    "armature": 12 * (0.006,), "motor_friction": BY_MOTOR, "kp": 12 * (0.8,), "kd": 12 * (1.3,),
    "saturation": 12 * (0.85,), "peak": 12 * (0.9,), "no_load_speed": 12 * (44.0,), "cutoff_speed": 12 * (20.0,),
    "offset": 12 * (0.03,),
    "knee_damping": (0.2,), "paw_friction": (0.6,), "latency": (0.025,), "spring_stiffness": (500.0,),
    "spring_length": (0.2,),
}  # fmt: skip
"""A value of every quantity, other than the described one."""
NOT_DRAWN = ("base_inertia", "saturation", "peak", "knee_damping", "spring_stiffness", "spring_length")
ROWS = {
    "base_mass": (("base_mass",), ("base_mass",), (-0.3, 0.1)),
    "base_com": (("com_shift",), ("com_shift",), (0.0, 0.01)),
    "link_mass": (("link_mass",), ("link_mass",), (0.97, 1.01)),
    "armature": (("armature",), ("armature",), (0.9, 1.2)),
    "kp": (("kp",), ("gains",), (0.9, 1.2)),
    "kd": (("kd",), ("damping_gains",), (0.9, 1.2)),
    "no_load_speed": (("no_load_speed",), ("no_load_speed",), (0.95, 1.2)),
    "cutoff_speed": (("cutoff_speed",), ("cutoff_speed",), (0.8, 1.2)),
    "offset": (("joint_offset",), ("joint_offset",), (-1.0, 0.5)),
    "motor_friction": (("motor_friction",), ("motor_friction",), (0.05, 0.06)),
    "paw_friction": (("dynamic_friction", "static_friction"), ("dynamic_friction", "static_friction"), (0.55, 0.65)),
    "latency": (("latency",), ("latency",), (21.0, 29.0)),
}
"""By quantity: the sampled parameters, the ranges that vary them, and a range that an overlay brings."""
ABSOLUTE = ("motor_friction", "paw_friction", "latency")
FACTORS = ("link_mass", "gains", "damping_gains", "no_load_speed", "cutoff_speed", "armature")
pytestmark = pytest.mark.usefixtures("one_thread")


def drawn(overlay, cfg=CFG, count=WORLDS, **settings):
    """Return the randomised parameters of many worlds by name; latencies in physics steps."""
    return read(randomized(cfg, count, robot=overlay, **settings))


@pytest.fixture(scope="module")
def described():
    """Return the samples around the described robot."""
    return drawn(None)


@pytest.fixture(scope="module")
def around():
    """Return the samples around the robot of VALUES, without ranges of its own."""
    return drawn(RobotOverlay(VALUES))


@pytest.fixture(scope="module")
def own():
    """Return the samples of the robot of VALUES with the ranges of ROWS."""
    ranges = {name: pair for _, names, pair in ROWS.values() for name in names}
    return drawn(RobotOverlay(VALUES, ranges))


@pytest.fixture(scope="module")
def nominal():
    """Return the parameters of the robot of VALUES and of the described one without randomisation, as columns."""
    return [drawn(overlay, OFF, 1) for overlay in (RobotOverlay(VALUES), None)]


def expected_range(name, pair, value):
    """Return the ends of the samples of a range, by its effect on an overlay's value."""
    pair = np.radians(pair) if name == "joint_offset" else np.array(pair)
    value = np.asarray(value, dtype=float)[..., None]
    return (value * pair if name in FACTORS else value + pair).reshape(-1, 2)


def test_every_quantity_of_an_overlay_is_covered():
    assert set(ROWS) | set(NOT_DRAWN) == set(vars(RobotValues.nominal(1))) == set(VALUES)


@pytest.mark.parametrize("quantity", [name for name in ROWS if name not in ABSOLUTE])
@pytest.mark.parametrize("brings", [False, True], ids=["task's range", "own range"])
def test_relative_range_applies_to_the_overlay_value(around, own, nominal, quantity, brings):
    (parameter,), (name,), pair = ROWS[quantity]
    pair = pair if brings else getattr(CFG, name) or CFG.gains
    samples, value = (own if brings else around)[parameter], nominal[0][parameter]
    for row, (low, high) in zip(np.atleast_2d(samples), expected_range(name, pair, value), strict=True):
        assert fills(row, low, high), quantity


def test_motor_friction_keeps_its_spread_around_the_value_of_each_motor(around):
    for row, value in zip(around["motor_friction"], np.array(BY_MOTOR), strict=True):
        assert fills(row, value - 0.015, value + 0.02)  # [N m] described: 0.02, range 0.005 to 0.04


def test_motor_friction_of_a_smooth_motor_is_cut_off_at_zero():
    assert fills(drawn(RobotOverlay({"motor_friction": 12 * (0.01,)}))["motor_friction"], 0.0, 0.03)


def test_friction_of_paws_keeps_its_spread(around):
    move = VALUES["paw_friction"][0] - PAW_FRICTION
    assert fills(around["dynamic_friction"], 0.8 + move, 0.9 + move)
    assert fills(around["static_friction"], 0.9 + move, 1.2 + move)


def test_latency_is_added_to_that_of_the_overlay(around, described):
    steps = 1000.0 * VALUES["latency"][0] / STEP_MS  # 12
    assert fills(around["latency"], steps, steps + 16.0 / STEP_MS + 0.5)
    np.testing.assert_array_equal(around["latency"] - described["latency"], np.full(WORLDS, steps))


@pytest.mark.parametrize("quantity", ABSOLUTE)
def test_absolute_range_of_an_overlay_is_not_moved(own, quantity):
    parameters, _, (low, high) = ROWS[quantity]
    for parameter in parameters:
        low, high = (round(end / STEP_MS) for end in (low, high)) if quantity == "latency" else (low, high)
        assert own[parameter].min() >= low - 1e-6 and own[parameter].max() <= high + 1e-6, parameter
        assert np.ptp(own[parameter]) > 0.9 * (high - low)


def test_nominal_latency_is_sampled_with_the_probability_of_zero():
    cfg = replace(CFG, zero_latency_probability=1.0)
    assert (drawn(RobotOverlay(VALUES), cfg, 8)["latency"] == 12).all()  # 25 ms
    within = RobotOverlay({}, {"latency": (4.0, 6.0)})
    assert (drawn(within, cfg, 8)["latency"] == 2).all()  # 4 ms, the end of its range nearest to 0
    assert not drawn(None, cfg, 8)["latency"].any()


def test_fixed_latency_is_fixed_where_zero_is_sampled():
    cfg = replace(CFG, zero_latency_probability=1.0, observation_latency=(4.0, 4.0)).with_fixed(latency=25.0)
    samples = drawn(None, cfg, 8)
    assert (samples["latency"] == 12).all() and (samples["observation_latency"] == 2).all()


@pytest.mark.parametrize("quantity", list(VALUES))
def test_a_quantity_moves_only_its_own_samples(described, quantity):
    same = drawn(RobotOverlay({quantity: tuple(vars(RobotValues.nominal(1))[quantity][0])}))
    for name, values in described.items():
        np.testing.assert_allclose(same[name], values, rtol=1e-6, err_msg=name)
    moved = drawn(RobotOverlay({quantity: VALUES[quantity]}), count=16)
    changed = {name for name in moved if not np.allclose(moved[name], described[name][..., :16], rtol=1e-5)}
    allowed = {"base_com": {"com_shift", "base_moments"}, "base_mass": {"base_mass", "base_moments"},
               "base_inertia": {"base_moments"}, "link_mass": {"link_mass", "link_moments"},
               "offset": {"joint_offset"}, "paw_friction": {"dynamic_friction", "static_friction"},
               "no_load_speed": {"no_load_speed", "cutoff_speed"}}  # fmt: skip
    assert changed <= allowed.get(quantity, {quantity})


def test_configuration_holds_the_resulting_ranges():
    env = randomized(CFG, 1, robot=RobotOverlay(VALUES, {"base_mass": (-0.1, 0.1)}))
    ranges = json.loads(json.dumps(env.config()))["ranges"]
    assert ranges["latency"] == pytest.approx([25.0, 41.0]) and ranges["base_mass"] == [-0.1, 0.1]
    assert ranges["motor_friction"][1] == pytest.approx([0.03, 0.065]) and len(ranges["motor_friction"]) == 12
    assert ranges["dynamic_friction"] == pytest.approx([0.5, 0.6]) and ranges["gains"] == [0.6, 1.4]
    assert "ranges" not in randomized(CFG, 1).config()


def test_report_names_the_ranges_that_the_overlay_changes():
    overlay, task = RobotOverlay({"latency": (0.005,)}, {"gains": (0.9, 1.1)}), make_task("vertical-jump")
    assert range_words(task, overlay, changed=True) == ["gains 0.9 to 1.1", "latency 5 to 21 ms"]
    assert "motor_friction 0.005 to 0.04 N m" in range_words(task, overlay)
    assert range_words(task, None, changed=True) == []


# ---------------------------------------------------------------- commands


@pytest.fixture
def overlay_file(tmp_path):
    """Return the file of an overlay with ranges of latency and masses."""
    values = {"latency": (0.005,), "paw_friction": (0.6,), "motor_friction": 12 * (0.06,), "base_mass": (8.0,)}
    RobotOverlay(values, {"latency": (4.0, 6.0), "base_mass": (-0.1, 0.1)}, "bench").save(tmp_path / "robot.json")
    return tmp_path / "robot.json"


@pytest.mark.parametrize(
    ("settings", "latency", "friction"),
    [
        ({"randomize": True}, (2, 3), (0.05, 0.6)),
        ({"randomize": True, "latency": 10.0, "friction": 0.4}, (5, 5), (0.4, 0.4)),
        ({}, (2, 2), (0.6, 0.6)),
    ],
)
def test_evaluation_samples_the_ranges_of_its_robot(overlay_file, tmp_path, settings, latency, friction):
    run = EvaluationRun("vertical_jump")
    run.prepare("evaluate", Conditions(device="cpu", robot=overlay_file, **settings), tmp_path)
    env = run.env(64)
    env.evaluation_reset((0.0, 0.0, 0.8))
    samples = read(env)
    assert (samples["latency"].min(), samples["latency"].max()) == latency
    assert friction[0] - 1e-6 <= samples["dynamic_friction"].min()
    assert samples["dynamic_friction"].max() <= friction[1] + 1e-6
    mass = samples["base_mass"] - 8.0
    assert 0.05 < np.abs(mass).max() <= 0.1 + 1e-5 if "randomize" in settings else np.abs(mass).max() < 1e-5
    assert ("ranges" in run.condition_values) == ("randomize" in settings)

"""Bounds of term numbers: a term and `Env.set` refuse the same values."""

import numpy as np
import pytest

from hold_height import hold_height
from jumper_warp.envs.skill import TaskRuntime
from jumper_warp.kernels.jump import rewards
from jumper_warp.registry import make_task
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.terms import RewardTerm
from jumper_warp.utils.errors import InputError

STEP_DT = 1.0 / 60.0
OUTSIDE = [
    ("observations.actor", "height", "clip", -5.0, "clip must be in 1e-06 to 1e\\+06, got -5"),
    ("observations.critic", "height", "scale", 0.0, "scale must be in 1e-06 to 1e\\+06, got 0"),
    ("curriculum", "height_error", "promote_after", 0, "promote_after at least 1"),
    ("curriculum", "height_error", "tolerance", -0.1, "tolerance must not be negative"),
    ("rewards", "near_goal", "width", 0.0, "'width' must be a width of 1e-06 to 1e\\+09, got 0.0"),
    ("events", "push", "interval_range_s.lower", 0.0, "interval_range_s must be .* above 0"),
    ("events", "push", "interval_range_s.upper", 0.1, "interval_range_s must be \\(lower, upper\\)"),
    ("events", "push", "probability", 1.5, "'probability' must be in 0 to 1"),
    ("events", "base_mass", "lower", -100.0, "range base_mass must be above -"),
    ("events", "link_mass", "lower", 0.0, "range link_mass must be above 0"),
    ("events", "gains", "kp_lower", 9.0, "range gains must rise, got"),
    ("events", "action_latency", "upper", 0.2, "range latency must be in 0 to 100 ms, got 200"),
]


@pytest.mark.parametrize(("section", "name", "key", "value", "message"), OUTSIDE)
def test_a_parameter_has_the_same_bounds_in_a_term_and_while_an_environment_runs(section, name, key, value, message):
    task = hold_height()
    skill = TaskRuntime(task, 0, 2, STEP_DT, 8, "cpu")
    before = skill.params.values.numpy()
    with pytest.raises(InputError, match=message):
        skill.params.set(f"{section}.{name}.{key}", value)
    np.testing.assert_array_equal(skill.params.values.numpy(), before)
    assert np.isinf(skill.params.changed.numpy()).all()
    term = next(slot.term for slot in task.params.slots[section] if slot.term.name == name)
    with pytest.raises(InputError, match=message):
        term.with_flat_numbers((term.flat_numbers | {key: value}).values())


@pytest.mark.parametrize(
    ("func", "name", "numbers"),
    [(rewards.soft_impact, "limit", {}), (rewards.landing_tilt, "angle", {}),
     (rewards.squat, "acceleration", {"std": 0.03, "takeoff_height": 0.3, "floor": 0.15})],
)  # fmt: skip
def test_refuses_to_divide_by_zero(func, name, numbers):
    with pytest.raises(InputError, match=f"'{name}' must be a width"):
        RewardTerm(func, 1.0, **numbers, **{name: 0.0})


def test_randomisation_at_the_ends_of_the_bounds_is_accepted():
    ranges = {"joint_offset": (-30.0, 30.0), "latency": (0.0, 100.0), "observation_latency": (0.0, 100.0)}
    assert len(RandomizationCfg(**ranges).events()) == 12


def test_both_ends_of_a_range_can_be_moved_in_turn_also_after_a_state_was_loaded():
    task = make_task("vertical-jump")
    first, second = (TaskRuntime(task, 0, 2, STEP_DT, 8, "cpu") for _ in range(2))
    for end in ("upper", "lower"):
        first.params.set(f"events.action_latency.{end}", 0.1)
    second.params.changed.assign(first.params.changed)
    second.params.restore()
    second.params.set("events.action_latency.lower", 0.05)
    numbers = second.params.values.numpy()[
        [task.params.index(f"events.action_latency.{e}") for e in ("lower", "upper")]
    ]
    np.testing.assert_allclose(numbers, [0.05, 0.1], rtol=1e-6)

import math

import numpy as np
import pytest

from jumper_warp.cli.evaluate import MEASURES, HeightFlags, PlaceFlags, csv_text, flags_for, measure_of, place_figures
from jumper_warp.evaluation.jumps import Jumps
from jumper_warp.evaluation.landings import ENDS
from jumper_warp.policies.spec import PolicyError
from jumper_warp.registry import TASKS, make_task

RULES = ("success", "came_apart", "low_base")


def test_every_task_is_measured_by_a_success_that_comes_first():
    assert set(MEASURES) == set(TASKS)
    for name, measure in MEASURES.items():
        task = make_task(name)
        rules = [rule.name for rule in (task if measure.change is None else measure.change(task)).rules]
        assert rules[0] == "success" and (measure.change is None or set(rules) == set(ENDS))


def test_task_without_a_measure_is_refused():
    with pytest.raises(PolicyError, match=r"vertical-jump, horizontal-jump, .* this one is of 'walk'"):
        measure_of("walk")


def test_places_are_spread_ahead_and_drawn_aside_and_headings_too():
    flags = flags_for("horizontal-jump", MEASURES["horizontal-jump"].flags, HeightFlags(), PlaceFlags(y=(-0.2, 0.1)))
    log = flags.log(5, RULES, seed=3)
    assert log.goals[:, 0, 0] == pytest.approx([0.3, 0.6, 0.9, 1.2, 1.5])
    aside = log.goals[:, 0, 1]
    assert -0.2 <= aside.min() < aside.max() <= 0.1
    assert len(set(log.headings)) == 5 and np.abs(log.headings).max() <= math.pi
    assert np.array_equal(flags.log(5, RULES, seed=3).goals, log.goals)
    assert not np.array_equal(flags.log(5, RULES, seed=4).headings, log.headings)


def test_one_heading_is_that_of_all_in_radians():
    assert PlaceFlags((0.3, 0.4), (0.0, 0.0), 90.0).log(2, RULES, 0).headings == pytest.approx(0.5 * math.pi)


def test_flags_of_another_task_are_refused():
    with pytest.raises(PolicyError, match="--x is not for policies of vertical-jump"):
        flags_for("vertical-jump", HeightFlags(), HeightFlags(), PlaceFlags(x=(0.3, 0.5)))
    with pytest.raises(PolicyError, match="--heading is not for policies of vertical-jump"):
        flags_for("vertical-jump", HeightFlags(), HeightFlags(), PlaceFlags(heading="any"))  # its own default
    with pytest.raises(PolicyError, match="--upper is not for policies of horizontal-jump"):
        flags_for("horizontal-jump", PlaceFlags(), HeightFlags(upper=1.0), PlaceFlags())


def test_range_of_places_counts_distances():
    goals = [[0.3, 0.0], [0.0, -0.3], [0.6, 0.6]]
    landings = PlaceFlags((0.0, 0.0), (0.0, 0.0), 0.0).log(3, RULES, 0)
    landings.goals[:, 0] = goals
    landings.place[:, 0], landings.target[:, 0] = goals, goals
    landings.heading[:], landings.yaw[:], landings.tilt[:] = 0.0, 0.0, 0.0
    landings.end[:, 0] = [0, 0, 2]
    figures = place_figures(landings, (0.3, 0.5))
    assert (figures["success_rate_in_range"], figures["success_rate"]) == (1.0, pytest.approx(2 / 3))
    assert (figures["range_lower_m"], figures["range_upper_m"]) == (0.3, 0.5)


def test_csv_has_a_line_a_jump_and_nothing_where_there_is_no_number():
    jumps = Jumps(np.array([0.5, 0.8]), RULES)
    jumps.end[:], jumps.apex[:] = [0, 1], [0.52, np.nan]
    assert csv_text(jumps).splitlines() == [
        "target_m,apex_m,error_m,end",
        "0.500000,0.520000,0.020000,success",
        "0.800000,,,came_apart",
    ]

import math
from dataclasses import replace

import numpy as np
import pytest

from jumper_warp.cli import evaluate, play
from jumper_warp.evaluation.commands import csv_text
from jumper_warp.evaluation.evaluations import EVALUATIONS, evaluation_of
from jumper_warp.evaluation.heights import HeightFlags, HeightLog
from jumper_warp.evaluation.landings import LANDING_TERMINATIONS, LandingFlags
from jumper_warp.policies.folder import save_policy
from jumper_warp.policies.spec import PolicyError
from jumper_warp.registry import TASKS, make_task
from jumper_warp.utils.errors import InputError
from landing_helpers import still_policy

TASK = EVALUATIONS["place"].prepare_task(make_task("horizontal-jump"))


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    """Folders of policies by task, which hold the default pose."""
    folder = tmp_path_factory.mktemp("policies")
    for name in ("vertical-jump", "horizontal-jump"):
        save_policy(folder / name, still_policy(name))
    return folder


def test_every_task_is_measured_by_a_success_that_comes_after_all_falls():
    kinds = {name: evaluation_of(make_task(name)) for name in TASKS if name.endswith("-jump")}
    assert [kinds[name] is EVALUATIONS[key] for name, key in (
        ("vertical-jump", "height"), ("horizontal-jump", "place"), ("omnidirectional-jump", "around"),
    )] == [True] * 3  # fmt: skip
    for name, kind in kinds.items():
        ends = [term.name for term in kind.prepare_task(make_task(name)).terminations]
        assert ends[-1] == "success" and (name == "vertical-jump" or set(ends) == set(LANDING_TERMINATIONS))


def test_task_with_an_unknown_evaluation_is_refused():
    with pytest.raises(PolicyError, match=r"horizontal-jump asks for the evaluation 'walk'; there are \['height', 'pl"):
        evaluation_of(replace(TASK, evaluation="walk"))


def test_places_are_spread_ahead_and_drawn_aside_and_headings_too():
    flags = LandingFlags(jumps=5, y=(-0.2, 0.1))
    log = flags.log(TASK, seed=3)
    assert log.goal_positions[:, 0, 0] == pytest.approx([0.3, 0.6, 0.9, 1.2, 1.5])
    aside = log.goal_positions[:, 0, 1]
    assert -0.2 <= aside.min() < aside.max() <= 0.1
    assert len(set(log.headings)) == 5 and np.abs(log.headings).max() <= math.pi
    assert np.array_equal(flags.log(TASK, seed=3).goal_positions, log.goal_positions)
    assert not np.array_equal(flags.log(TASK, seed=4).headings, log.headings)


def test_one_heading_is_that_of_all_in_radians():
    assert LandingFlags(jumps=2, x=(0.3, 0.4), y=(0.0, 0.0), heading=90.0).log(TASK, 0).headings == pytest.approx(
        0.5 * math.pi
    )


@pytest.mark.parametrize(
    ("task", "args", "flag"),
    [
        ("vertical-jump", ["--x", "0.3", "0.5"], "--x"),
        ("vertical-jump", ["--heading", "any"], "--heading"),
        ("horizontal-jump", ["--upper", "1.0"], "--upper"),
        ("horizontal-jump", ["--episodes", "3"], "--episodes"),
    ],
)
def test_flags_of_another_task_are_refused(policies, task, args, flag):
    with pytest.raises(InputError, match=f"{flag} is not for policies of {task}; jumper evaluate .* --help shows"):
        evaluate.run([str(policies / task), *args], [])


@pytest.mark.parametrize(
    ("task", "suite", "there"),
    [("vertical-jump", ["grid"], "sweep"), ("horizontal-jump", [], "sweep, grid, ring, consecutive, platform, max")],
)
def test_suite_of_another_task_is_refused(policies, task, suite, there):
    with pytest.raises(InputError, match=f"no suite '.*' for policies of {task}; there are {there}$"):
        evaluate.run([str(policies / task), "--suite", *suite], [])


@pytest.mark.parametrize("command", [evaluate, play])
def test_help_shows_the_flags_of_the_policy_only(policies, capsys, command):
    shown = {}
    for task in ("vertical-jump", "horizontal-jump"):
        with pytest.raises(SystemExit) as end:
            command.run([str(policies / task), "--help"], [])
        assert end.value.code == 0
        shown[task] = capsys.readouterr().out
    flags = {evaluate: ("--upper", "--heading"), play: ("--height", "--goal")}[command]
    for task, there, missing in (("vertical-jump", *flags), ("horizontal-jump", *reversed(flags))):
        assert there in shown[task] and missing not in shown[task] and "--solver" in shown[task]


@pytest.mark.parametrize("command", [evaluate, play])
@pytest.mark.parametrize("args", [[], ["--height", "0.9", "vertical_jump"]])
def test_policy_comes_first(command, args):
    with pytest.raises(InputError, match=r"the policy comes first: jumper (play|evaluate) POLICY"):
        command.run(args, [])


def test_range_of_places_counts_distances():
    goals = [[0.3, 0.0], [0.0, -0.3], [0.6, 0.6]]
    flags = LandingFlags(jumps=3, x=(0.0, 0.0), y=(0.0, 0.0), heading=0.0, in_range=(0.3, 0.5))
    landings = flags.log(TASK, 0)
    landings.goal_positions[:, 0] = goals
    landings.end_position[:, 0], landings.goal_world[:, 0] = goals, goals
    landings.heading[:], landings.yaw[:], landings.tilt[:] = 0.0, 0.0, 0.0
    landings.end[:, 0] = [*[LANDING_TERMINATIONS.index("success")] * 2, LANDING_TERMINATIONS.index("low_base")]
    metrics = flags.metrics(landings)
    assert (metrics["success_rate_in_range"], metrics["success_rate"]) == (1.0, pytest.approx(2 / 3))
    assert (metrics["range_lower_m"], metrics["range_upper_m"]) == (0.3, 0.5)


def test_heights_are_spread_evenly():
    assert HeightFlags(jumps=3, lower=0.6, upper=1.0).log(TASK, 0).commanded[:, 0] == pytest.approx([0.6, 0.8, 1.0])


def test_csv_has_a_line_a_jump_and_nothing_where_there_is_no_number():
    jumps = HeightLog(np.array([0.5, 0.8]), ("success", "came_apart", "low_base"))
    jumps.end[:, 0], jumps.apex[:, 0], jumps.heading[:] = [0, 1], [0.52, np.nan], 0.0
    assert csv_text(jumps).splitlines() == [
        "target_m,apex_m,error_m,end",
        "0.500000,0.520000,0.020000,success",
        "0.800000,,,came_apart",
    ]

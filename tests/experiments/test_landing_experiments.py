import dataclasses
import math

import numpy as np
import pytest

from columns import X, Y
from jumper_warp.evaluation.conditions import Conditions, env_of_recipe
from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.log import run_evaluation
from jumper_warp.evaluation.suites import Consecutive, Farthest, Grid, Platform, consecutive_metrics, distance_metrics
from jumper_warp.evaluation.sweeps import DistanceSweep
from jumper_warp.policies.policy import save_policy
from jumper_warp.tasks.jump.evaluation import TERMINATIONS
from jumper_warp.utils.output import read_values
from jumper_warp.utils.rotations import turn_plane
from landing_helpers import OPEN_LOOP_APEX, OpenLoopPolicy, still_policy
from metric_helpers import values

COLLIDED, NO_JUMP, LANDED = (TERMINATIONS.index(name) for name in ("collided", "no_jump", "success"))
SHARED = {"solver", "randomize", "seed", "stream", "rest_s", "trained_range_m"}
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """Folder of a policy that stands still."""
    folder = tmp_path_factory.mktemp("policy") / "still"
    save_policy(folder, still_policy("horizontal-jump"))
    return str(folder)


def landing_log(goals, landing, end, **changes):
    """Return the log of finished jumps of heading 0.

    goals, landing [m]: (worlds, jumps, 2), world; end: indices of terminations; changes: other arrays of the log.
    """
    landings = JumpLog(np.array(goals, dtype=float), TERMINATIONS)
    landings.end[:] = end
    landings.goal_world[:], landings.end_position[:], landings.touchdown[:] = goals, landing, landing
    landings.takeoff[:], landings.rest_position[:], landings.rest_speed[:] = 0.0, landing, 0.0
    landings.heading[:], landings.yaw[:], landings.tilt[:] = 0.0, 0.0, 0.0
    for name, value in changes.items():
        getattr(landings, name)[:] = value
    return landings


def goals_ahead(distances):
    """Return goals [m], (n, 1, 2), straight ahead at distances [m], (n,)."""
    return np.stack([distances, np.zeros(len(distances))], axis=1)[:, None]


# ---------------------------------------------------------------- metrics by hand


def test_sweep_metrics_count_ranges_by_distance():
    goals = goals_ahead([0.3, 0.7, 1.0, 1.4, 1.5])
    errors = [[[0.02, 0.0]], [[0.0, 0.04]], [[0.0, 0.2]], [[0.03, 0.0]], [[-0.5, 0.0]]]
    landings = landing_log(goals, goals + errors, LANDED)
    metrics = values(DistanceSweep().flags.metrics(landings))
    assert metrics["goal_distance_at_rest_mean_m"] == pytest.approx(0.79 / 5)
    assert metrics["success_rate"] == pytest.approx(3 / 5)
    assert metrics["in_range_success_rate"] == pytest.approx(3 / 4)


def test_consecutive_metrics_match_hand_computed_values():
    goals = [[[0.8, 0.2], [0.75, -0.2]], [[0.8, 0.0], [0.8, 0.0]]]
    off = [[[0.01, 0.0], [0.0, 0.03]], [[0.05, 0.0], [0.2, 0.0]]]
    pairs = landing_log(goals, np.add(goals, off), LANDED)
    ends = [[LANDED] * 3, [LANDED, COLLIDED, -1]]
    row = landing_log(np.ones((2, 3, 2)), np.ones((2, 3, 2)) + [0.0, 0.04], ends)
    row.heading[1, 2] = row.end_position[1, 2] = row.rest_position[1, 2] = np.nan
    row.rest_speed[:] = [[0.05, 0.2, 0.05], [0.05, np.inf, np.inf]]
    metrics = values(consecutive_metrics(pairs, row))
    expected = {
        "goal_distance_at_rest_mean_m": 0.29 / 4,
        "success_rate": 3 / 4,
        "diagonal_goal_distance_at_rest_mean_m": 0.02,
        "straight_goal_distance_at_rest_mean_m": 0.125,
        "jump_1_goal_distance_at_rest_mean_m": 0.03,
        "jump_2_goal_distance_at_rest_mean_m": 0.115,
        "both_landed_rate": 1.0,
        "row_all_landed_rate": 0.5,
        "row_all_success_rate": 0.0,
        "row_landed_jumps_mean": 2.0,
        "row_at_rest_rate": 3 / 5,
        "row_goal_distance_at_rest_mean_m": 0.04,
        "row_success_rate": 3 / 5,
        "fall_rate": 0.0,
        "miss_rate": 1 / 4,
        "row_fall_rate": 1 / 5,
        "row_miss_rate": 0.0,
    }
    assert {name: metrics[name] for name in expected} == pytest.approx(expected)


def test_row_without_fall_may_miss_goals():
    off = np.ones((2, 3, 2)) + [[[0.0, 0.0]] * 3, [[0.0, 0.0], [0.3, 0.0], [0.0, 0.0]]]
    pairs, row = np.ones((2, 2, 2)), landing_log(np.ones((2, 3, 2)), off, LANDED)
    metrics = values(consecutive_metrics(landing_log(pairs, pairs, LANDED), row))
    assert (metrics["row_all_landed_rate"], metrics["row_all_success_rate"]) == (1.0, 0.5)


def test_vectors_turn_about_z():
    turned = turn_plane(np.array([[0.0, 1.0], [1.0, 0.0]]), np.array([-0.5 * math.pi, 0.5 * math.pi]))
    assert turned == pytest.approx(np.array([[1.0, 0.0], [0.0, 1.0]]))


def bin_log(middle, *, clean, stepped=0, hopped=0):
    """Return the log of 20 jumps over `middle` m: numbers of clean, stepped, hopped ones, the others collide.

    Jumps end 0.01 m beyond the goal and touch down 0.2 m short of it.
    """
    goals, good = goals_ahead([middle] * 20), clean + stepped + hopped
    air = [[0.0]] * (clean + stepped) + [[0.1]] * (20 - clean - stepped)
    lift = [[0.0]] * clean + [[0.1]] * (20 - clean)
    end = [[LANDED]] * good + [[COLLIDED]] * (20 - good)
    return landing_log(goals, goals + [0.01, 0.0], end, air_time=air, lift_time=lift, touchdown=goals - [0.2, 0.0],
                       paw_shift=np.array([middle - 0.1, 0.0]))  # fmt: skip


@pytest.mark.parametrize(("direction", "unit"), [(0.0, (1.0, 0.0)), (90.0, (0.0, 1.0)), (180.0, (-1.0, 0.0))])
def test_bin_goals_lie_in_commanded_direction(direction, unit):
    expected = np.array([0.75, 0.775, 0.8, 0.825, 0.85])[:, None, None] * np.array(unit)
    np.testing.assert_allclose(Farthest(num_jumps=5, direction=direction).goals(0.8), expected, atol=1e-12)
    one = Farthest(num_jumps=1, direction=direction).goals(0.8)
    np.testing.assert_allclose(one, 0.8 * np.array(unit)[None, None], atol=1e-12)


def test_reliable_distance_is_last_bin_before_first_failure():
    bins = {
        1.2: bin_log(1.2, clean=19),
        1.3: bin_log(1.3, clean=10, stepped=10),
        1.4: bin_log(1.4, clean=10, hopped=9),
        1.5: bin_log(1.5, clean=10, stepped=8),
        1.6: bin_log(1.6, clean=20),
    }
    metrics = values(distance_metrics(bins))
    expected = {
        "reliable_distance_m": 1.4, "reliable_distance_without_hop_m": 1.3,
        "reliable_distance_without_paw_lift_m": 1.2, "reliable_distance_flown_m": 1.2,
        "reliable_distance_flown_without_hop_m": 1.1, "reliable_distance_flown_without_paw_lift_m": 1.0,
        "reliable_paw_to_paw_distance_m": 1.3, "fall_rate": 0.04, "miss_rate": 0.0, "no_paw_lift_rate": 0.69,
        "landing_tilt_max_deg": 0.0, "success_rate": 0.96, "success_without_hop_rate": 0.87,
        "success_without_paw_lift_rate": 0.69, "in_range_success_rate": 58 / 60, "goal_distance_at_rest_mean_m": 0.01,
    }  # fmt: skip
    assert {name: metrics[name] for name in expected} == pytest.approx(expected)
    assert metrics["bin_success_rate"] == pytest.approx([0.95, 1.0, 0.95, 0.9, 1.0])
    assert metrics["bin_success_without_hop_rate"] == pytest.approx([0.95, 1.0, 0.5, 0.9, 1.0])
    assert metrics["bin_success_without_paw_lift_rate"] == pytest.approx([0.95, 0.5, 0.5, 0.5, 1.0])
    assert metrics["bin_distance_flown_mean_m"] == pytest.approx([1.0, 1.1, 1.2, 1.3, 1.4])


def test_distance_metrics_without_reliable_bin_are_none():
    goals = goals_ahead([1.0, 1.0])
    bins = {1.0: landing_log(goals, goals, [[NO_JUMP], [NO_JUMP]])}
    metrics = values(distance_metrics(bins))
    assert metrics["reliable_distance_m"] is None and metrics["reliable_distance_flown_without_hop_m"] is None
    assert metrics["bin_paw_to_paw_distance_mean_m"] == [None] and metrics["landing_tilt_max_deg"] is None


def test_goals_in_range_may_lie_in_any_direction():
    aside = goals_ahead([1.0, 1.4, 1.5])[..., ::-1]
    metrics = distance_metrics({1.0: landing_log(aside, aside, [[NO_JUMP]] * 3)})
    assert metrics["in_range_success_rate"].trials == 2


def test_platform_scenes_have_specified_ground_block_and_headings():
    rng, goals = np.random.default_rng(0), np.array([[0.8, 0.1], [1.0, -0.1]])
    scenes = {name: scene for name, *scene in Platform(edge=0.46).scenes(goals, rng)}
    ground = scenes["platform"][0]["ground"]
    assert (ground.min_z, ground.max_z) == pytest.approx((-0.15, 0.0))
    x = np.linspace(-ground.hx, ground.hx, ground.ncol)
    heights = np.asarray(ground.data).reshape(ground.nrow, ground.ncol)
    assert x[heights[0] > 0.5].max() == pytest.approx(0.46) and (heights == heights[0]).all()
    assert len(set(scenes["uneven"][1])) == 2
    block, headings = scenes["block"][0]["block"], scenes["block"][1]
    near, far = (block.center[:, X] + side * block.half[:, 0] for side in (-1.0, 1.0))
    assert near == pytest.approx(0.46) and far == pytest.approx(goals[:, X] + 0.40)
    assert block.center[:, Y] == pytest.approx(goals[:, Y]) and not headings.any()
    assert [name for name, *_ in Platform(solver="mujoco").scenes(goals, rng)] == ["platform", "uneven"]


# ---------------------------------------------------------------- real jumps


@pytest.fixture(scope="module")
def hops():
    """Log of two open-loop hops in place of each of three robots, which have different goals."""
    policy = still_policy("horizontal-jump")
    ends = set(TERMINATIONS) - {"no_jump"}  # the script squats longer than `no_jump` allows

    def change(task):
        return dataclasses.replace(task, terminations=tuple(term for term in task.terminations if term.name in ends))

    env = env_of_recipe(policy.recipe(), 3, Conditions(device="cpu"), change=change)
    goals = np.array([[[0.0, 0.0], [0.0, 0.05]], [[0.05, 0.0], [0.3, 0.0]], [[0.5, -0.2], [0.0, 0.0]]])
    landings = JumpLog(
        goals, env.task.termination_names, headings=np.array([0.0, 2.0, -1.5]), delay=np.array([0.5, 0.4, 0.3])
    )
    script = OpenLoopPolicy()

    def restart_script():
        if (landings.current == 1).any() and script.begin == 31:
            script.begin = script.step + 1

    run_evaluation(script.act, env, landings, seconds=8.0, on_step=restart_script)
    return landings


def test_hop_in_place_lands_at_start_and_misses_far_goal(hops):
    outcome = hops.outcome
    assert outcome.landed.all() and not outcome.early.any() and not outcome.hopped.any()
    assert ((hops.apex > 0.9) & (hops.apex < OPEN_LOOP_APEX)).all()
    assert hops.landing[:, 0] == pytest.approx(np.zeros((3, 2)), abs=0.06)
    assert hops.outcomes[:, 0].tolist() == ["success", "success", "missed"]
    assert outcome.distance_at_end_m[2, 0] == pytest.approx(math.hypot(0.5, 0.2), abs=0.06)


def test_second_jump_goal_is_relative_to_end_of_first(hops):
    goal = hops.goal_world[:, 1] - hops.end_position[:, 0]  # [m] commanded 0.05, 0.3 and 0 m away
    assert np.linalg.norm(goal, axis=1) == pytest.approx([0.05, 0.3, 0.0], abs=1e-3)
    assert hops.outcomes[:, 1].tolist() == ["success", "missed", "success"]


# ---------------------------------------------------------------- the suites


@pytest.mark.parametrize(
    ("suite", "settings", "files"),
    [
        (DistanceSweep, {"num_jumps": 3}, ("sweep.png", "jumps.rrd", "jumps.png")),
        (Grid, {"columns": 2, "rows": 2, "num_jumps": 1}, ("grid.png", "jumps.rrd")),
        (Consecutive, {"num_jumps": 1, "num_trials": 2, "jumps_per_trial": 3}, ("paths.png", "pairs.rrd", "row.rrd")),
        (Platform, {"num_jumps": 2}, ("landings.png", "platform.rrd", "uneven.png", "block.rrd")),
        (Farthest, {"num_jumps": 3}, ("max_jump.png", "jump_1.0_m.rrd")),
    ],
)
def test_suite_writes_metrics_plot_and_recording(suite, settings, files, policy, tmp_path):
    reported = suite(policy=policy, num_recorded=1, out=tmp_path, device="cpu", **settings).run()
    saved = read_values(tmp_path)
    assert saved == reported and saved.keys() >= SHARED | suite.paper.keys()
    success = "uneven_success_rate" if suite is Platform else "success_rate"
    assert (saved[success], saved["torque_limit_nm"]) == (0.0, 18.0)
    for name in files:
        assert (tmp_path / name).stat().st_size > 1000, name

import math
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from jumper_warp.evaluation.jumps import wrapped, yaw_of
from jumper_warp.evaluation.places import PlaceLog, ended_by_takeoff, for_evaluation, landing_metrics, trained_range
from jumper_warp.registry import make_task

DT = 1.0 / 60.0
TERMINATIONS = ("success", "came_apart", "low_base", "collided", "no_jump")
COLLIDED, NO_JUMP = 3, 4
QUARTER = math.radians(90.0)


def about_z(angle):
    return [0.0, 0.0, math.sin(0.5 * angle), math.cos(0.5 * angle)]


class Stub:
    """An environment whose worlds do what the test says, each jump relative to where its robot is."""

    def __init__(self, count):
        self.num_envs, self.step_dt, self.commanded = count, DT, []
        self.task = SimpleNamespace(contact_force=0.1)
        force = wp.full((4, count), wp.vec3(0.0, 0.0, 9.0), dtype=wp.vec3, device="cpu")
        self.sim = SimpleNamespace(paw_force=force, base_velocity=lambda: self.arrays["base_vel"])
        self.arrays = {
            "base_quat": np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), "start": np.zeros((count, 3)),
            "base_pos": np.zeros((count, 3)),
            "base_vel": np.zeros((count, 3)), "goal": np.zeros((count, 3)), "heading": np.zeros(count),
            "max_height": np.zeros(count), "peak_tilt": np.zeros(count), "took_off": np.zeros(count, dtype=int),
            "steps": np.full(count, 40), "command_step": np.full(count, 30), "termination": np.full(count, -1),
            "touched_down": np.zeros(count, dtype=int),
            "phase": np.zeros(count, dtype=int), "phase_steps": np.zeros(count, dtype=int),
        }  # fmt: skip

    def evaluation_reset(self, goals, headings):
        self.command_step = goals[:, 3]
        cos, sin = np.cos(headings), np.sin(headings)
        self.arrays["goal"][:, 0] = cos * goals[:, 0] - sin * goals[:, 1]
        self.arrays["goal"][:, 1] = sin * goals[:, 0] + cos * goals[:, 1]
        self.arrays["heading"][:] = headings

    def command(self, goals, worlds):
        self.commanded.append((goals.copy(), worlds.copy()))
        for name in ("phase", "phase_steps"):
            self.arrays[name][worlds] = 0
        self.arrays["goal"][worlds] = self.arrays["base_pos"][worlds] + goals[worlds, :3]

    def task_arrays(self):
        return self.arrays

    def now(self, **changes):
        for name, value in changes.items():
            self.arrays[name][:] = value

    def stand_on(self, *down):
        """Load the given paws of every world by 9 N, the others by a twentieth of a newton."""
        loads = np.zeros((4, self.num_envs, 3))
        loads[..., 2] = np.where(np.isin(range(4), down), 9.0, 0.05)[:, None]
        self.sim.paw_force.assign(loads)


def five_jumps():
    """One good, one that misses, one that comes apart, one that collides, one without a jump; heading left."""
    goals = np.array([[[1.0, 0.0]], [[0.6, 0.2]], [[0.8, 0.0]], [[1.2, 0.0]], [[0.5, 0.0]]])
    landings = PlaceLog(goals, TERMINATIONS, QUARTER)
    env = Stub(5)
    landings.begin(env)
    # headed to the left, the goals lie at (-y, x)
    touchdown = [[0.05, 0.9, 0.4], [-0.2, 0.8, 0.4], *([[0.0] * 3] * 3)]
    env.now(base_pos=touchdown, phase=[2, 2, 1, 1, 0], touched_down=[1, 1, 0, 0, 0])
    assert not landings.follow(env)
    env.now(touched_down=0)
    env.now(base_pos=[[0.05, 0.93, 0.3], [-0.2, 0.7, 0.3], *([[0.0] * 3] * 3)], phase_steps=[18, 18, 3, 3, 9])
    assert not landings.follow(env)
    env.now(
        base_pos=[[0.03, 0.96, 0.3], [-0.2, 0.8, 0.3], [1e9, 0.0, 0.0], [0.0, 0.9, 0.1], [0.0, 0.0, 0.3]],
        base_quat=[about_z(QUARTER + 0.1), about_z(QUARTER - 0.3), *([[0.0, 0.0, 0.0, 1.0]] * 3)],
        base_vel=[[0.0, 0.06, 0.0], [0.2, 0.0, 0.0], *([[0.0] * 3] * 3)],
        phase=[2, 2, 1, 2, 0], phase_steps=[60, 60, 3, 20, 9], termination=[0, -1, 1, COLLIDED, NO_JUMP],
        peak_tilt=[0.1, 0.2, 3.0, 1.0, 0.0], max_height=[0.6, 0.5, 9.0, 0.7, 0.3],
    )  # fmt: skip
    assert landings.follow(env)
    return landings


def test_landing_is_measured_ahead_and_to_the_left_of_the_heading():
    landings = five_jumps()
    assert landings.landing[:2, 0] == pytest.approx(np.array([[0.96, -0.03], [0.8, 0.2]]), abs=1e-6)
    assert landings.offset[:2, 0] == pytest.approx(np.array([[-0.04, -0.03], [0.2, 0.0]]), abs=1e-6)
    assert landings.outcomes[:, 0].tolist() == ["success", "missed", "came_apart", "collided", "no_jump"]


def test_metrics_by_hand():
    landings = five_jumps()
    inside = np.array([True, True, True, False, False])[:, None]
    expected = {
        "jumps": 5,
        "mean_error_m": (0.05 + 0.2 + 0.3 + 0.5) / 4,
        "mean_error_in_range_m": (0.05 + 0.2) / 2,
        "mean_error_of_successes_m": 0.05,
        "max_error_of_successes_m": 0.05,
        "max_error_m": 0.5,
        "mean_error_ahead_m": (-0.04 + 0.2 - 0.3 - 0.5) / 4,
        "mean_error_left_m": -0.03 / 4,
        "success_rate": 1 / 5,
        "success_rate_in_range": 1 / 3,
        "single_jump_success_rate": 1 / 5,
        "step_free_success_rate": 1 / 5,
        "landing_rate": 2 / 5,
        "second_hop_rate": 0.0,
        "step_rate": 0.0,
        "mean_error_at_touchdown_m": (math.hypot(0.05, 0.1) + 0.2) / 2,
        "mean_error_0_3_s_after_touchdown_m": (math.hypot(0.05, 0.07) + 0.1) / 2,
        "still_landing_rate": 2 / 5,
        "still_landing_rate_in_range": 2 / 3,
        "second_takeoff_rate": 0.0,
        "at_rest_within_1_s_rate": 1 / 2,
        "mean_landing_tilt_deg": math.degrees(0.15),
        "max_landing_tilt_deg": math.degrees(0.2),
        "mean_turn_deg": math.degrees(0.2),
        "max_turn_deg": math.degrees(0.3),
        "collision_rate": 1 / 5,
        "fall_rate": 2 / 5,
        "miss_rate": 1 / 5,
        "early_rate": 0.0,
        "came_apart": 1,
        "failed_by_missed": 1,
        "failed_by_came_apart": 1,
        "failed_by_collided": 1,
        "failed_by_no_jump": 1,
    }
    assert landing_metrics(landings, inside) == pytest.approx(expected, abs=1e-6)


def test_nothing_changes_after_the_end():
    landings = five_jumps()
    before = landings.landing.copy()
    later = Stub(5)
    later.now(termination=COLLIDED, base_pos=7.0)
    assert landings.follow(later)
    assert np.array_equal(landings.landing, before) and landings.success.sum() == 1


def test_jump_before_the_command_is_no_success():
    landings, env = PlaceLog(np.zeros((1, 1, 2)), TERMINATIONS), Stub(1)
    landings.begin(env)
    env.now(took_off=1, steps=29)
    assert not landings.follow(env)
    env.now(took_off=0, steps=120, phase=2, phase_steps=60)
    assert landings.follow(env)
    metrics = landing_metrics(landings)
    assert (metrics["success_rate"], metrics["early_rate"], metrics["landing_rate"]) == (0.0, 1.0, 1.0)
    assert metrics["failed_by_early"] == 1


@pytest.mark.parametrize(("steps", "hopped"), [([3, 3], False), ([1, 4], True)])
def test_long_enough_in_the_air_after_touchdown_is_another_jump(steps, hopped):
    landings, env = PlaceLog(np.zeros((1, 1, 2)), TERMINATIONS), Stub(1)
    landings.begin(env)
    for phase, force, count in ((1, 0.0, 20), (2, 0.0, steps[0]), (2, 9.0, 2), (2, 0.05, steps[1])):
        env.now(phase=phase)
        env.sim.paw_force.fill_(wp.vec3(0.0, 0.0, force))
        for _ in range(count):
            assert not landings.follow(env)
    env.now(phase_steps=60)
    env.sim.paw_force.fill_(wp.vec3(0.0, 0.0, 9.0))
    assert landings.follow(env)
    assert landings.air_time[0, 0] == pytest.approx(max(steps) * DT)
    metrics = landing_metrics(landings)
    assert (metrics["success_rate"], metrics["second_hop_rate"]) == (1.0, float(hopped))
    assert metrics["single_jump_success_rate"] == float(not hopped)


@pytest.mark.parametrize(
    ("contacts", "stepped"),
    [
        ([((0, 1), 8), ((0, 1, 2, 3), 20)], False),  # hind paws that come down later were not lifted
        ([((0, 1, 2, 3), 2), ((1, 2, 3), 2), ((0, 1, 2, 3), 2), ((1, 2, 3), 2), ((0, 1, 2, 3), 2)], False),
        ([((0, 1, 2, 3), 2), ((1, 2, 3), 3), ((0, 1, 2, 3), 2)], True),
        ([((0,), 1), ((1, 2), 3), ((0, 1, 2, 3), 2)], True),
    ],
)
def test_paw_lifted_again_after_its_own_contact_is_a_step(contacts, stepped):
    landings, env = PlaceLog(np.zeros((1, 1, 2)), TERMINATIONS), Stub(1)
    landings.begin(env)
    for phase, rows in ((0, [((0, 1, 2, 3), 5)]), (1, [((), 20)]), (2, contacts)):
        env.now(phase=phase)
        for down, count in rows:
            env.stand_on(*down)
            for _ in range(count):
                assert not landings.follow(env)
    env.now(phase_steps=60)
    assert landings.follow(env)
    metrics = landing_metrics(landings)
    assert (metrics["success_rate"], metrics["second_hop_rate"]) == (1.0, 0.0)
    assert (metrics["step_rate"], metrics["step_free_success_rate"]) == (float(stepped), float(not stepped))


@pytest.mark.parametrize(
    ("moments", "takeoffs"),
    [
        ([((), 0.3, 1)], 1),
        ([((), 0.2, 5)], 0),  # too slow
        ([((0,), 0.6, 5)], 0),  # a paw is down
        ([((), 0.2, 2), ((), 0.3, 2), ((), -0.5, 3)], 1),  # one takeoff, however long it flies
        ([((), 0.3, 2), ((0, 1, 2, 3), 0.0, 2), ((), 0.5, 1)], 2),
    ],
)
def test_second_takeoffs_are_upward_with_no_paw_down(moments, takeoffs):
    landings, env = PlaceLog(np.zeros((1, 1, 2)), TERMINATIONS), Stub(1)
    landings.begin(env)
    env.stand_on()
    env.now(phase=1, base_vel=[0.0, 0.0, 3.0])  # the jump's own takeoff is none
    assert not landings.follow(env)
    env.now(phase=2, touched_down=1, base_vel=[0.0, 0.0, 0.0])
    env.stand_on(0, 1, 2, 3)
    assert not landings.follow(env)
    env.now(touched_down=0)
    for down, up, count in moments:
        env.stand_on(*down)
        env.now(base_vel=[0.0, 0.0, up])
        for _ in range(count):
            assert not landings.follow(env)
    env.now(phase_steps=60, base_vel=0.0)
    env.stand_on(0, 1, 2, 3)
    assert landings.follow(env)
    assert landings.takeoffs[0, 0] == takeoffs
    metrics = landing_metrics(landings)
    assert (metrics["success_rate"], metrics["second_takeoff_rate"]) == (1.0, float(takeoffs > 0))


def test_fall_after_the_first_second_counts_where_the_jump_is_followed_for_longer():
    landings, env = PlaceLog(np.zeros((2, 1, 2)), TERMINATIONS, rest=3.0), Stub(2)
    landings.begin(env)
    env.now(phase=2, phase_steps=60, termination=0)
    assert not landings.follow(env)
    env.now(phase_steps=120, termination=[0, 2])
    assert not landings.follow(env)
    env.now(phase_steps=180, termination=0)
    assert landings.follow(env)
    assert landings.outcomes[:, 0].tolist() == ["success", "low_base"]
    metrics = landing_metrics(landings)
    assert (metrics["success_rate"], metrics["fall_rate"], metrics["miss_rate"]) == (0.5, 0.5, 0.0)
    assert "at_rest_within_1_s_rate" not in metrics and metrics["below_0_1_m_s_at_the_end_rate"] == 1.0


def test_flight_of_the_next_jump_is_no_step():
    landings, env = PlaceLog(np.zeros((1, 2, 2)), TERMINATIONS), Stub(1)
    landings.begin(env)
    env.now(phase=2, phase_steps=60)
    assert not landings.follow(env) and len(env.commanded) == 1
    env.now(phase=1)
    env.stand_on()
    for _ in range(9):
        assert not landings.follow(env)
    env.now(phase=2, phase_steps=60)
    assert landings.follow(env)
    assert landings.success.all() and not landings.stepped.any()


def test_jump_that_does_not_end_fails_where_it_is():
    landings, env = PlaceLog(np.array([[[0.4, 0.0]]]), TERMINATIONS), Stub(1)
    landings.begin(env)
    assert not landings.follow(env)
    metrics = landing_metrics(landings)
    assert metrics["mean_error_m"] == pytest.approx(0.4) and metrics["failed_by_no_end"] == 1


def two_in_a_row():
    """A row that goes through, and one whose first jump collides."""
    landings, env = PlaceLog(np.array([[[0.8, 0.2], [0.7, 0.0]]] * 2), TERMINATIONS, rest=0.5), Stub(2)
    landings.begin(env)
    env.now(base_pos=[0.8, 0.15, 0.3], phase=2, phase_steps=[29, 10], termination=[-1, COLLIDED])
    assert not landings.follow(env) and not env.commanded
    env.now(phase_steps=30)
    assert not landings.follow(env)
    return landings, env


def test_next_jump_is_commanded_after_the_rest_and_only_after_a_landing():
    _, env = two_in_a_row()
    ((goals, worlds),) = env.commanded
    assert worlds.tolist() == [True, False]
    assert goals[0] == pytest.approx([0.7, 0.0, 0.0])


def test_next_jump_is_measured_from_its_own_goal():
    landings, env = two_in_a_row()
    env.now(base_pos=[[1.48, 0.15, 0.3], [0.0, 0.0, 0.0]], phase=2, phase_steps=30, termination=0)
    assert landings.follow(env)
    assert landings.error[0] == pytest.approx([0.05, 0.02])
    assert landings.outcomes.tolist() == [["success", "success"], ["collided", "not_begun"]]
    metrics = landing_metrics(landings)
    assert metrics["jumps"] == 3 and metrics["success_rate"] == pytest.approx(2 / 3)
    assert "success_rate_in_range" not in metrics and "mean_error_in_range_m" not in metrics
    everywhere = landing_metrics(landings, np.ones((2, 2), dtype=bool))
    assert everywhere["success_rate_in_range"] == pytest.approx(2 / 3)
    assert landings.marks([0])[0, :, :2] == pytest.approx(np.array([[0.8, 0.2], [1.5, 0.15]]))


def test_columns_have_a_row_a_jump_and_none_for_jumps_that_were_not_begun():
    landings, _ = two_in_a_row()
    columns = landings.columns()
    assert all(len(values) == 4 for values in columns.values())
    assert columns["goal_x_m"] == [0.8, 0.7, 0.8, 0.7]
    assert columns["error_m"][3] is None and columns["end"][3] == "not_begun"
    assert landings.series([1])["distance/goal of 1 [m]"] == pytest.approx(0.05)


def test_terminations_of_an_evaluation_leave_the_shaping_out():
    terms = for_evaluation(make_task("horizontal-jump")).terminations
    assert [term.name for term in terms] == ["came_apart", "low_base", "collided", "no_jump", "success"]
    terms = ended_by_takeoff(make_task("horizontal-jump")).terminations
    assert [term.name for term in terms][-2:] == ["second_takeoff", "success"]


@pytest.mark.parametrize(("task", "range_m"), [("horizontal-jump", [0.2, 2.2]), ("omnidirectional-jump", [0.0, 1.4])])
def test_trained_range_is_that_of_all_levels_straight_ahead(task, range_m):
    assert list(trained_range(make_task(task)).values()) == range_m


def test_each_world_may_have_its_own_time_of_the_command():
    env = Stub(2)
    PlaceLog(np.zeros((2, 1, 2)), TERMINATIONS, delay=np.array([0.5, 0.25])).begin(env)
    assert env.command_step.tolist() == [30.0, 15.0]


def test_row_has_time_for_every_jump():
    assert PlaceLog(np.zeros((1, 2, 2)), TERMINATIONS).seconds == pytest.approx(10.5)


def test_goals_of_another_shape_are_refused():
    with pytest.raises(ValueError, match="goals must have shape"):
        PlaceLog(np.zeros((3, 2)), TERMINATIONS)


@pytest.mark.parametrize("angle", [-3.0, -0.5, 0.0, 2.0])
def test_yaw_of_a_turn_about_z(angle):
    assert yaw_of(np.array([about_z(angle)]))[0] == pytest.approx(angle)


def test_wrapped_angle_is_the_short_way_round():
    assert wrapped(np.radians([190.0, -350.0])) == pytest.approx(np.radians([-170.0, 10.0]))

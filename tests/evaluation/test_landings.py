import math
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from jumper_warp.evaluation.jump_metrics import jump_metrics, range_metrics
from jumper_warp.evaluation.jumps import JumpLog, wrapped
from jumper_warp.evaluation.trained import trained_range
from jumper_warp.registry import make_task
from metric_helpers import values

DT = 1.0 / 60.0  # [s] Policy step
TERMINATIONS = ("success", "diverged", "low_base", "collided", "no_jump")
COLLIDED, NO_JUMP = 3, 4  # Indices in TERMINATIONS
QUARTER = math.radians(90.0)


def quat_about_z(angle):
    """Return the quaternion (xyzw) of a rotation by an angle [rad] about z."""
    return [0.0, 0.0, math.sin(0.5 * angle), math.cos(0.5 * angle)]


class StubEnv:
    """An environment whose arrays are set by the test; commanded goals are relative to the base."""

    def __init__(self, count):
        self.num_envs, self.step_dt, self.commanded = count, DT, []
        self.task = SimpleNamespace(contact_force=0.1)
        force = wp.full((4, count), wp.vec3(0.0, 0.0, 9.0), dtype=wp.vec3, device="cpu")
        self.robot = SimpleNamespace(paw_pos=wp.zeros((4, count), dtype=wp.vec3, device="cpu"))
        self.sim = SimpleNamespace(
            paw_force=force, base_velocity=lambda: self.arrays["base_vel"], joint_q=lambda: np.zeros((count, 43))
        )
        self.arrays = {
            "base_quat": np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), "start": np.zeros((count, 3)),
            "base_pos": np.zeros((count, 3)),
            "base_vel": np.zeros((count, 3)), "goal": np.zeros((count, 3)), "heading": np.zeros(count),
            "peak_tilt": np.zeros(count), "took_off": np.zeros(count, dtype=int),
            "steps": np.full(count, 40), "command_step": np.full(count, 30), "termination": np.full(count, -1),
            "touched_down": np.zeros(count, dtype=int),
            "phase": np.zeros(count, dtype=int), "phase_steps": np.zeros(count, dtype=int),
        }  # fmt: skip

    def evaluation_reset(self, goals, headings):  # stub of Env: goals (n, 4) of `jump_commands`, headings [rad]
        self.command_step = goals[:, 3]
        cos, sin = np.cos(headings), np.sin(headings)
        self.arrays["goal"][:, 0] = cos * goals[:, 0] - sin * goals[:, 1]
        self.arrays["goal"][:, 1] = sin * goals[:, 0] + cos * goals[:, 1]
        self.arrays["heading"][:] = headings

    def command(self, goals, worlds):  # stub of Env: goals (n, 3) [m] for worlds (n,) bool
        self.commanded.append((goals.copy(), worlds.copy()))
        for name in ("phase", "phase_steps"):
            self.arrays[name][worlds] = 0
        self.arrays["goal"][worlds] = self.arrays["base_pos"][worlds] + goals[worlds, :3]

    def task_arrays(self):  # stub of Env
        return self.arrays

    def set(self, **changes):  # arrays by name, or one value for all worlds
        for name, value in changes.items():
            self.arrays[name][:] = value

    def stand_on(self, *down):
        """Load the paws `down` (0 FL, 1 FR, 2 BL, 3 BR) of every world by 9 N, the others by 0.05 N, below contact."""
        loads = np.zeros((4, self.num_envs, 3))
        loads[..., 2] = np.where(np.isin(range(4), down), 9.0, 0.05)[:, None]
        self.sim.paw_force.assign(loads)


def five_jumps():
    """Return the log of five jumps headed 90° left: success, miss, divergence, collision, no jump."""
    goals = np.array([[[1.0, 0.0]], [[0.6, 0.2]], [[0.8, 0.0]], [[1.2, 0.0]], [[0.5, 0.0]]])
    landings = JumpLog(goals, TERMINATIONS, QUARTER)
    env = StubEnv(5)
    landings.begin(env)
    # headed to the left, the goals lie at (-y, x)
    touchdown = [[0.05, 0.9, 0.4], [-0.2, 0.8, 0.4], *([[0.0] * 3] * 3)]
    env.set(base_pos=touchdown, phase=[2, 2, 1, 1, 0], touched_down=[1, 1, 0, 0, 0])
    assert not landings.record_step(env)
    env.set(touched_down=0)
    env.set(base_pos=[[0.05, 0.93, 0.3], [-0.2, 0.7, 0.3], *([[0.0] * 3] * 3)], phase_steps=[18, 18, 3, 3, 9])
    assert not landings.record_step(env)
    env.set(
        base_pos=[[0.03, 0.96, 0.3], [-0.2, 0.8, 0.3], [1e9, 0.0, 0.0], [0.0, 0.9, 0.1], [0.0, 0.0, 0.3]],
        base_quat=[quat_about_z(QUARTER + 0.1), quat_about_z(QUARTER - 0.3), *([[0.0, 0.0, 0.0, 1.0]] * 3)],
        base_vel=[[0.0, 0.06, 0.0], [0.2, 0.0, 0.0], *([[0.0] * 3] * 3)],
        phase=[2, 2, 1, 2, 0], phase_steps=[60, 60, 3, 20, 9], termination=[0, -1, 1, COLLIDED, NO_JUMP],
        peak_tilt=[0.1, 0.2, 3.0, 1.0, 0.0],
    )  # fmt: skip
    assert landings.record_step(env)
    return landings


def test_landing_offset_and_outcome_are_in_heading_frame():
    landings = five_jumps()
    assert landings.landing[:2, 0] == pytest.approx(np.array([[0.96, -0.03], [0.8, 0.2]]), abs=1e-6)
    outcome = landings.outcome
    assert outcome.ahead_m[:2, 0] == pytest.approx([-0.04, 0.2]) and outcome.left_m[:2, 0] == pytest.approx(
        [-0.03, 0.0], abs=1e-6
    )
    assert landings.outcomes[:, 0].tolist() == ["success", "missed", "diverged", "collided", "no_jump"]


def test_landing_metrics_match_hand_computed_values():
    landings = five_jumps()
    inside = np.array([True, True, True, False, False])[:, None]
    expected = {
        "goal_distance_at_end_mean_m": (0.05 + 0.2 + 0.3 + 0.5) / 4,
        "goal_distance_at_rest_mean_m": (0.05 + 0.2) / 2,
        "goal_distance_at_rest_max_m": 0.2,
        "goal_distance_at_touchdown_mean_m": (math.hypot(0.05, 0.1) + 0.2) / 2,
        "goal_error_ahead_signed_mean_m": (-0.04 + 0.2) / 2,
        "goal_error_left_signed_mean_m": -0.03 / 2,
        "distance_flown_mean_m": None,
        "paw_to_paw_distance_mean_m": None,
        "success_rate": 1 / 5,
        "success_at_touchdown_rate": 0.0,
        "stance_height_mean_m": 0.2,
        "squat_height_mean_m": 0.0,
        "height_at_end_mean_m": 0.3,
        "transversal_angle_max_deg": 0.0,
        "goal_reached_rate": 1 / 5,
        "landed_rate": 2 / 5,
        "at_rest_rate": 1 / 5,
        "no_paw_lift_rate": 2 / 5,
        "success_without_hop_rate": 1 / 5,
        "success_without_paw_lift_rate": 1 / 5,
        "second_takeoff_rate": 0.0,
        "landing_tilt_below_10_deg_rate": 1 / 2,
        "landing_tilt_mean_deg": math.degrees(0.15),
        "landing_tilt_max_deg": math.degrees(0.2),
        "turn_abs_mean_deg": math.degrees(0.2),
        "turn_abs_max_deg": math.degrees(0.3),
        "collision_rate": 1 / 5,
        "fall_rate": 2 / 5,
        "miss_rate": 1 / 5,
        "early_rate": 0.0,
        "no_jump_rate": 1 / 5,
        "diverged_rate": 1 / 5,
    }
    assert values(jump_metrics(landings.outcome)) == pytest.approx(expected, abs=1e-6)
    in_range = range_metrics(landings.outcome, inside, "near")
    assert {key: (metric.value, metric.trials) for key, metric in in_range.items()} == {
        "in_range_success_rate": (1 / 3, 3), "in_range_goal_reached_rate": (1 / 3, 3),
        "in_range_no_paw_lift_rate": (2 / 3, 3), "in_range_goal_distance_at_rest_mean_m": (pytest.approx(0.125), 2),
    }  # fmt: skip
    assert in_range["in_range_success_rate"].over == "jumps near"


def test_distances_flown_and_from_paw_to_paw_are_horizontal():
    landings, env = JumpLog(np.zeros((1, 1, 2)), TERMINATIONS), StubEnv(1)
    landings.begin(env)
    paws = np.zeros((4, 1, 3))
    for changes, shift, down in (
        ({}, [0.0, 0.0], (0, 1, 2, 3)),
        ({"phase": 1, "took_off": 1, "base_pos": [0.1, 0.0, 0.6]}, [0.3, 0.0], ()),
        ({"phase": 2, "took_off": 0, "touched_down": 1, "base_pos": [0.7, 0.8, 0.3]}, [1.2, 0.5], (0, 1)),
        ({"phase_steps": 60, "touched_down": 0, "base_pos": [0.9, 0.8, 0.3]}, [1.2, 0.5], (0, 1, 2, 3)),
    ):
        env.set(**changes)
        env.stand_on(*down)
        paws[..., :2] = shift
        env.robot.paw_pos.assign(paws)
        landings.record_step(env)
    metrics = values(jump_metrics(landings.outcome))
    assert metrics["distance_flown_mean_m"] == pytest.approx(1.0)
    assert metrics["paw_to_paw_distance_mean_m"] == pytest.approx(1.3)


def test_jump_before_command_is_not_a_success():
    landings, env = JumpLog(np.zeros((1, 1, 2)), TERMINATIONS), StubEnv(1)
    landings.begin(env)
    env.set(took_off=1, steps=29)
    assert not landings.record_step(env)
    env.set(took_off=0, steps=120, phase=2, phase_steps=60)
    assert landings.record_step(env)
    metrics = values(jump_metrics(landings.outcome))
    assert (metrics["success_rate"], metrics["early_rate"], metrics["landed_rate"]) == (0.0, 1.0, 1.0)
    assert landings.outcomes[0, 0] == "early"


@pytest.mark.parametrize(("steps", "hopped"), [([3, 3], False), ([1, 4], True)])
def test_airtime_above_hop_time_after_touchdown_is_second_hop(steps, hopped):  # policy steps of 1/60 s, limit 3
    landings, env = JumpLog(np.zeros((1, 1, 2)), TERMINATIONS), StubEnv(1)
    landings.begin(env)
    for phase, force, count in ((1, 0.0, 20), (2, 0.0, steps[0]), (2, 9.0, 2), (2, 0.05, steps[1])):
        env.set(phase=phase)
        env.sim.paw_force.fill_(wp.vec3(0.0, 0.0, force))
        for _ in range(count):
            assert not landings.record_step(env)
    env.set(phase_steps=60)
    env.sim.paw_force.fill_(wp.vec3(0.0, 0.0, 9.0))
    assert landings.record_step(env)
    assert landings.air_time[0, 0] == pytest.approx(max(steps) * DT)
    metrics = values(jump_metrics(landings.outcome))
    assert (metrics["success_rate"], metrics["success_without_hop_rate"]) == (1.0, float(not hopped))


@pytest.mark.parametrize(
    ("contacts", "stepped"),
    [
        ([((0, 1), 8), ((0, 1, 2, 3), 20)], False),  # hind paws that come down later were not lifted
        ([((0, 1, 2, 3), 2), ((1, 2, 3), 2), ((0, 1, 2, 3), 2), ((1, 2, 3), 2), ((0, 1, 2, 3), 2)], False),
        ([((0, 1, 2, 3), 2), ((1, 2, 3), 3), ((0, 1, 2, 3), 2)], True),
        ([((0,), 1), ((1, 2), 3), ((0, 1, 2, 3), 2)], True),
    ],
)
def test_paw_lifted_3_policy_steps_after_its_contact_is_a_step(contacts, stepped):  # rows: paws down, policy steps
    landings, env = JumpLog(np.zeros((1, 1, 2)), TERMINATIONS), StubEnv(1)
    landings.begin(env)
    for phase, rows in ((0, [((0, 1, 2, 3), 5)]), (1, [((), 20)]), (2, contacts)):
        env.set(phase=phase)
        for down, count in rows:
            env.stand_on(*down)
            for _ in range(count):
                assert not landings.record_step(env)
    env.set(phase_steps=60)
    assert landings.record_step(env)
    metrics = values(jump_metrics(landings.outcome))
    assert (metrics["success_rate"], metrics["success_without_hop_rate"]) == (1.0, 1.0)
    assert metrics["no_paw_lift_rate"] == metrics["success_without_paw_lift_rate"] == float(not stepped)


@pytest.mark.parametrize(
    ("phases", "takeoffs"),  # phases: paws down, upward speed [m/s], policy steps
    [
        ([((), 0.3, 1)], 1),
        ([((), 0.2, 5)], 0),  # too slow
        ([((0,), 0.6, 5)], 0),  # a paw is down
        ([((), 0.2, 2), ((), 0.3, 2), ((), -0.5, 3)], 1),  # one takeoff, however long it flies
        ([((), 0.3, 2), ((0, 1, 2, 3), 0.0, 2), ((), 0.5, 1)], 2),
    ],
)
def test_second_takeoff_needs_upward_speed_and_no_contact(phases, takeoffs):
    landings, env = JumpLog(np.zeros((1, 1, 2)), TERMINATIONS), StubEnv(1)
    landings.begin(env)
    env.stand_on()
    env.set(phase=1, base_vel=[0.0, 0.0, 3.0])  # the takeoff of the jump itself does not count
    assert not landings.record_step(env)
    env.set(phase=2, touched_down=1, base_vel=[0.0, 0.0, 0.0])
    env.stand_on(0, 1, 2, 3)
    assert not landings.record_step(env)
    env.set(touched_down=0)
    for down, up, count in phases:
        env.stand_on(*down)
        env.set(base_vel=[0.0, 0.0, up])
        for _ in range(count):
            assert not landings.record_step(env)
    env.set(phase_steps=60, base_vel=0.0)
    env.stand_on(0, 1, 2, 3)
    assert landings.record_step(env)
    assert landings.takeoffs[0, 0] == takeoffs
    metrics = values(jump_metrics(landings.outcome))
    assert (metrics["success_rate"], metrics["second_takeoff_rate"]) == (1.0, float(takeoffs > 0))


def test_longer_rest_time_counts_later_falls_but_not_later_speed():
    landings, env = JumpLog(np.zeros((2, 1, 2)), TERMINATIONS, rest=3.0), StubEnv(2)
    landings.begin(env)
    env.set(phase=2, phase_steps=60, termination=0)
    assert not landings.record_step(env)
    env.set(phase_steps=120, termination=[0, 2], base_vel=0.5)
    assert not landings.record_step(env)
    env.set(phase_steps=180, termination=0)
    assert landings.record_step(env)
    assert landings.outcomes[:, 0].tolist() == ["success", "low_base"]
    metrics = values(jump_metrics(landings.outcome))
    assert (metrics["success_rate"], metrics["fall_rate"], metrics["miss_rate"]) == (0.5, 0.5, 0.0)
    assert metrics["at_rest_rate"] == 0.5


def test_flight_of_next_jump_is_not_counted_as_step():
    landings, env = JumpLog(np.zeros((1, 2, 2)), TERMINATIONS), StubEnv(1)
    landings.begin(env)
    env.set(phase=2, phase_steps=60)
    assert not landings.record_step(env) and len(env.commanded) == 1
    env.set(phase=1)
    env.stand_on()
    for _ in range(9):
        assert not landings.record_step(env)
    env.set(phase=2, phase_steps=60)
    assert landings.record_step(env)
    assert landings.success.all() and landings.outcome.still.all()


def test_unfinished_jump_fails_at_last_position():
    landings, env = JumpLog(np.array([[[0.4, 0.0]]]), TERMINATIONS), StubEnv(1)
    landings.begin(env)
    assert not landings.record_step(env)
    metrics = values(jump_metrics(landings.outcome))
    assert metrics["goal_distance_at_end_mean_m"] == pytest.approx(0.4) and landings.outcomes[0, 0] == "no_end"


def two_in_a_row():
    """Return the log and environment of two rows of two jumps after the first: world 0 landed, world 1 collided."""
    landings, env = JumpLog(np.array([[[0.8, 0.2], [0.7, 0.0]]] * 2), TERMINATIONS, rest=0.5), StubEnv(2)
    landings.begin(env)
    env.set(base_pos=[0.8, 0.15, 0.3], phase=2, phase_steps=[29, 10], termination=[-1, COLLIDED])
    assert not landings.record_step(env) and not env.commanded
    env.set(phase_steps=30)
    assert not landings.record_step(env)
    return landings, env


def test_next_jump_is_commanded_only_after_rest_of_landed_jump():
    landings, env = two_in_a_row()
    ((goals, worlds),) = env.commanded
    assert worlds.tolist() == [True, False]
    assert goals[0] == pytest.approx([0.7, 0.0, 0.0])
    env.set(base_pos=[0.8, 0.15, 0.28])  # it squats
    landings.record_step(env)
    assert landings.outcome.stance_m[0, 1] == pytest.approx(0.3)


def test_next_jump_has_error_outcome_and_marker_of_its_own_goal():
    landings, env = two_in_a_row()
    env.set(base_pos=[[1.48, 0.15, 0.3], [0.0, 0.0, 0.0]], phase=2, phase_steps=30, termination=0)
    assert landings.record_step(env)
    assert landings.outcome.distance_at_rest_m[0] == pytest.approx([0.05, 0.02])
    assert landings.outcomes.tolist() == [["success", "success"], ["collided", "not_begun"]]
    success = jump_metrics(landings.outcome)["success_rate"]
    assert (success.value, success.trials) == (pytest.approx(2 / 3), 3)
    assert landings.marks()["goals"][0, :, :2] == pytest.approx(np.array([[0.8, 0.2], [1.5, 0.15]]))


@pytest.mark.parametrize(
    ("task", "range_m"),
    [("horizontal-jump", [0.2, 2.2]), ("horizontal-jump-standing", [0.0, 2.2]), ("vertical-jump", [0.45, 1.15])],
)
def test_trained_range_covers_all_levels(task, range_m):
    assert trained_range(make_task(task)) == {"trained_range_m": range_m}


def test_command_delay_may_differ_between_worlds():
    env = StubEnv(2)
    JumpLog(np.zeros((2, 1, 2)), TERMINATIONS, delay=np.array([0.5, 0.25])).begin(env)
    assert env.command_step.tolist() == [30.0, 15.0]  # policy steps


def test_wrapped_angle_is_within_pi():
    assert wrapped(np.radians([190.0, -350.0])) == pytest.approx(np.radians([-170.0, 10.0]))

"""Course log and metrics on an environment of scripted robots."""

from types import SimpleNamespace

import numpy as np
import pytest

from jumper_warp.evaluation.courses import JUMP_TIMEOUT, CourseLog, active_spans, course_metrics
from jumper_warp.evaluation.scripts import ScriptStep
from jumper_warp.evaluation.skills import JUMP_TO, JUMP_UP, WALK
from jumper_warp.evaluation.velocities import SLEW_RATE
from metric_helpers import values

DT = 1.0 / 60.0  # [s] Policy step
SLEW_STEP = SLEW_RATE * DT  # Largest change of a commanded velocity in a policy step
SCRIPT = (  # 120 policy steps of walking, a jump, 90 of walking
    ScriptStep("walk", (0.5, 0.1, -0.2), 2.0),
    ScriptStep("jump_up", (0.75,)),
    ScriptStep("walk", (0.3, 0, 0), 1.5),
)


class ScriptedEnv:
    """Robots that stop 50 steps after a jump is requested, take off 25 steps later and finish 40 steps after that."""

    def __init__(self, n: int, error=(0.1, 0.0, 0.0), falls_at=None, never_stops=False, ground=0.0):
        """Create n standing robots.

        error: of the velocity; falls_at: (n,) policy step of each fall, -1: none; ground: height [m].
        """
        self.ground = ground
        self.n, self.error, self.falls_at, self.never_stops = n, np.array(error), falls_at, never_stops
        self.skill, self.commands, self.age, self.command_values = np.zeros(n, int), np.full(n, -1), np.zeros(n), None
        self.step_dt, self.steps, self.velocity, self.requests = DT, 0, np.zeros((n, 3)), []
        goals = np.zeros(n, dtype=[("goal", float, 3)])
        goals["goal"] = np.arange(3 * n).reshape(n, 3)
        self.skills = 3 * [SimpleNamespace(states=SimpleNamespace(numpy=lambda: goals))]
        self.placed = []
        place = lambda center, worlds: self.placed.append((self.steps, center.tolist(), worlds))  # noqa: E731
        self.sim = SimpleNamespace(solver=SimpleNamespace(place_blocks=place))

    def evaluation_reset(self, commands, headings):  # stub of Env
        self.velocity = np.array(commands, dtype=float)

    def command(self, values, worlds):  # stub of Env: robots that walk get velocities (n, 3)
        walking = worlds & (self.skill == WALK)
        self.velocity[walking] = values[walking]
        self.command_values = values.copy()

    def request(self, skill, worlds, commands):  # stub of Env: records (step, skill, world)
        self.goals = commands.copy()
        self.requests += [(self.steps, skill, int(w)) for w in np.flatnonzero(worlds)]
        self.commands[worlds] = skill
        self.age[worlds] = 0

    def step(self):
        """Advance by a policy step, and return the arrays of `CourseLog.read_env`."""
        self.steps += 1
        self.age += 1
        jumping = self.skill >= JUMP_UP
        took_off, touched_down = jumping & (self.age == 25), jumping & (self.age == 45)
        phase = jumping * ((self.age >= 25).astype(int) + (self.age >= 45))
        heights = 0.78 - 0.002 * (self.age - 35) ** 2  # [m] apex 35 steps after the handover, back at 0.58 m
        base_pos = np.stack([np.full(self.n, 0.05), np.zeros(self.n), np.where(jumping, heights, 0.4)], axis=1)
        base_pos[jumping & (self.age > 50), 2] = 0.9  # [m] higher after touchdown, which is no apex
        base_pos[:, 2] += self.ground
        for w in range(self.n):
            if self.skill[w] == WALK and self.commands[w] >= 0 and self.age[w] >= 50 and not self.never_stops:
                self.skill[w], self.commands[w], self.age[w] = self.commands[w], -1, 0
            elif self.skill[w] >= JUMP_UP and self.age[w] >= 65:
                self.skill[w], self.age[w] = WALK, 0
        termination = np.where(self.falls_at == self.steps, 1, -1) * np.ones(self.n, int)
        return {
            "base_pos": base_pos, "base_quat": np.tile([0.0, 0.0, 0.0, 1.0], (self.n, 1)),
            "base_vel": self.velocity * [1, 1, 0] + self.error * [1, 1, 0],
            "base_ang_vel": (self.velocity + self.error)[:, 2:] * [0.0, 0.0, 1.0],
            "skill": self.skill.copy(), "termination": termination,
            "force": np.tile([30.0, 31.0, 32.0, 33.0], (self.n, 1)) + (self.steps % 2),
            "jump_goal_ground": np.full(self.n, self.ground),
            "jump_goal": np.zeros((self.n, 3)), "jump_took_off": took_off.astype(int),
            "jump_touched_down": touched_down.astype(int), "jump_phase": phase,
        }  # fmt: skip


def run_course(script=SCRIPT, n=2, **env_settings) -> tuple[CourseLog, ScriptedEnv]:
    """Return the log of a script on n robots, run to its end, and the environment; env_settings: of ScriptedEnv."""
    course, env = CourseLog([script] * n), ScriptedEnv(n, **env_settings)
    course.read_env = lambda env: env.step()
    course.begin(env)
    for _ in range(round(course.seconds / DT)):
        if course.record_step(env):
            break
    return course, env


def test_jump_is_requested_at_its_command_and_walking_resumes():
    course, env = run_course()
    assert env.requests == [(120, JUMP_UP, 0), (120, JUMP_UP, 1)]  # 2 s of walking; then 50 + 65 steps of a jump
    np.testing.assert_allclose(env.goals, [[0.0, 0.0, 0.75, 30.0]] * 2)  # SQUAT_TIME of 30 steps
    assert [skill for skill, *_ in active_spans(course, 0)] == [WALK, JUMP_UP, WALK]
    np.testing.assert_array_equal(course.start_step[0], [0, 120, 235])
    np.testing.assert_array_equal(course.finish_step[0], [120, 235, 325])
    assert course.switch_step[0, 1] == 170 and course.takeoff_step[0, 1] == 195
    assert (course.outcomes == "done").all() and not course.fallen.any() and course.on_goal.all()
    commands = np.array(course.commands)[:, 0]
    np.testing.assert_allclose(commands[[0, 119, 150]], [[0, 0, 0], [0.5, 0.1, -0.2], [0, 0, 0]])
    slewed = [0.5 - 2 * SLEW_STEP, 0.1 - 2 * SLEW_STEP, 2 * SLEW_STEP - 0.2]
    np.testing.assert_allclose(commands[121], slewed, rtol=1e-5)
    assert np.isnan(commands[171:234]).all() and commands[300] == pytest.approx([0.3, 0.0, 0.0])
    assert env.command_values[0] == pytest.approx([0.3, 0.0, 0.0])


def test_course_metrics_match_hand_computed_values():
    course, _ = run_course(error=(0.1, -0.2, 0.05))
    metrics = values(course_metrics(course))
    rmse = [metrics[f"settled_slewed_rmse_{name}"] for name in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s")]
    assert rmse == pytest.approx([0.1, 0.2, 0.05], rel=1e-5)
    assert sum(np.array(course.is_tracked)[:, 0]) == 60 + 30  # the first second of each command does not count
    assert metrics["apex_error_abs_mean_m"] == pytest.approx(0.03)
    assert metrics["goal_distance_at_handover_mean_m"] is None
    assert metrics["command_to_takeoff_mean_s"] == pytest.approx(75 * DT)
    assert metrics["command_to_jump_skill_mean_s"] == pytest.approx(50 * DT)
    assert (metrics["finished_rate"], metrics["finished_on_goal_rate"], metrics["jump_made_rate"]) == (1, 1, 1)
    assert metrics["handover_force_ripple_mean_n"] == pytest.approx(1.0) == metrics["handover_force_step_mean_n"]


def test_apex_on_a_block_is_above_the_block():
    assert run_course(ground=0.05)[0].apex_error[0, 1] == pytest.approx(0.03)


def test_landing_error_is_distance_from_goal_and_beyond_tolerance_off_goal():
    course, _ = run_course((ScriptStep("jump_to", (0.8, 0.0)), ScriptStep("stand", seconds=0.2)), n=1)
    assert course.switch_step[0, 0] > 0
    assert values(course_metrics(course))["goal_distance_at_handover_mean_m"] == pytest.approx(0.05)
    course.offset[0, 0] = 0.2
    assert values(course_metrics(course))["finished_on_goal_rate"] == 0.0
    assert values(course_metrics(course))["finished_rate"] == 1.0
    assert [skill for skill, *_ in active_spans(course, 0)] == [WALK, JUMP_TO, WALK]


def test_block_is_placed_under_goal_when_jump_onto_it_starts():
    plain, onto = (ScriptStep(kind, (1.3, 0.1)) for kind in ("jump_to", "jump_onto"))
    course, env = CourseLog([(plain, plain), (plain, onto)]), ScriptedEnv(2)
    assert course.block is not None and CourseLog([(plain, plain)]).block is None
    course.read_env = lambda env: env.step()
    course.begin(env)
    while not course.record_step(env):
        pass
    switch_step = course.switch_step[1, 1]
    assert env.placed == [(switch_step, [[3.0, 4.0]], [1])] and switch_step > course.finish_step[1, 0]


def test_fall_ends_course_and_its_samples():
    course, _ = run_course(falls_at=np.array([60, -1]))
    metrics = values(course_metrics(course))
    assert course.outcomes.tolist() == ["collided", "done"] and metrics["ended_by_collided_rate"] == 0.5
    assert (metrics["finished_rate"], metrics["fall_rate"]) == (0.5, 0.5)
    assert np.isnan(np.array(course.velocity)[60:, 0]).all() and not np.array(course.is_tracked)[60:, 0].any()


def test_robot_that_never_stops_has_outcome_stuck():
    course, env = run_course(never_stops=True)
    metrics = values(course_metrics(course))
    assert course.outcomes.tolist() == ["stuck", "stuck"] and env.steps == 120 + round(JUMP_TIMEOUT / DT)
    assert metrics["ended_by_stuck_rate"] == 1.0 and metrics["command_to_takeoff_mean_s"] is None

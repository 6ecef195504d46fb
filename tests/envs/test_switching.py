"""Handovers between the shipped policies on one robot: their order, and the state after them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.evaluation.courses import SQUAT_TIME, CourseLog
from jumper_warp.evaluation.run import SkillRun
from jumper_warp.evaluation.scripts import parse_script
from jumper_warp.evaluation.skills import JUMP_TO, JUMP_UP, WALK
from jumper_warp.policies.spec import PolicyError
from jumper_warp.robot.overlay import RobotOverlay

N = 2
SCRIPTS = [
    parse_script([{"walk": [0.5, 0.0, 0.3], "seconds": 0.6}, {"jump_up": 0.75}, {"stand": 0.2}, {"jump_to": [0.6, 0.1]},
                  {"stand": 0.2}]),
    parse_script([{"stand": 0.4}, {"jump_to": [0.7, 0.0]}, {"walk": [0.0, 0.3, 0.0], "seconds": 0.5}, {"jump_up": 0.6},
                  {"stand": 0.2}]),
]  # fmt: skip


def coordinates(env) -> np.ndarray:
    """Return joint_q and joint_qd of each world side by side, (worlds, 81)."""
    return np.concatenate([env.sim.joint_q(), env.sim.joint_qd()], axis=1)


class Switch:
    """State, observation and next filtered target of a world at a handover."""

    def __init__(self, env: Env, world: int) -> None:
        self.world, self.target = world, int(env.episodes.skill.numpy()[world])
        self.after, self.action = coordinates(env)[world], env.robot.action.numpy()[:, world].copy()
        self.obs = env.skills[self.target].obs["actor"][world].clone()
        self.state = env.skills[self.target].states.numpy()[world].copy()
        self.next_action = self.next_safe = None


@pytest.fixture(scope="module")
def followed():
    """Return policies, environment, course and all handovers of a nominal run whose stages are launched one by one."""
    policies = SkillRun()
    policies.conditions = Conditions(device="cpu", threads=1)
    env = policies.env(N)
    act = policies.actor(env)
    course, switches, fresh = CourseLog(SCRIPTS), [], []
    course.begin(env)
    for _ in range(round(course.seconds / env.step_dt)):
        env.actions.copy_(act(env.obs))
        for name, stage in env.stages().items():
            if name == "reset":
                was = env.episodes.skill.numpy().copy()
            stage()
            if name == "action":
                for each in fresh:
                    each.next_action = env.robot.action.numpy()[:, each.world].copy()
                    each.next_safe = env.robot.filtered_target.numpy()[:, each.world].copy()
        fresh = [Switch(env, w) for w in np.flatnonzero(env.episodes.skill.numpy() != was)]
        switches += fresh
        if course.record_step(env):
            break
    return policies, env, course, switches


def test_skills_have_the_order_of_the_scripts(followed):
    _, _, course, switches = followed
    order = [[s.target for s in switches if s.world == w] for w in range(N)]
    assert order == [[JUMP_UP, WALK, JUMP_TO, WALK], [JUMP_TO, WALK, JUMP_UP, WALK]]
    assert (course.outcomes == "done").all() and course.on_goal.all()
    assert abs(course.apex_error[0, 1]) < 0.02 and np.nanmax(course.landing_error) < 0.05


def test_observation_and_filter_after_a_handover_equal_those_of_a_new_environment_in_the_same_state(followed):
    policies, _, _, switches = followed
    for target in (WALK, JUMP_UP, JUMP_TO):
        cases = [s for s in switches if s.target == target]
        alone = Env(policies.skills[target], N, device="cpu", randomize=False, noise=False, auto_reset=False, threads=1)
        alone.evaluation_reset(np.zeros((N, 3)))
        for s in cases:
            q, qd, action = (
                a.numpy().copy() for a in (alone.sim.state.joint_q, alone.sim.state.joint_qd, alone.robot.action)
            )
            split = len(q) // N
            q[:split], qd[: len(qd) // N], action[:, 0] = s.after[:split], s.after[split:], s.action
            for array, values in (
                (alone.sim.state.joint_q, q),
                (alone.sim.state.joint_qd, qd),
                (alone.robot.action, action),
            ):
                array.assign(values)
            states = alone.skills[0].states.numpy().copy()
            states[0] = s.state
            alone.skills[0].states.assign(wp.array(states, dtype=alone.task.state, device="cpu"))
            alone.episodes.history_reset.fill_(1)
            alone._observe(alone._part(), after_reset=1)
            assert torch.equal(alone.obs[0], s.obs), (target, alone.obs[0] - s.obs)
            alone.action[0] = torch.from_numpy(s.next_action)
            alone.stages()["action"]()
            np.testing.assert_array_equal(alone.robot.filtered_target.numpy()[:, 0], s.next_safe)


def test_jumps_are_commanded_squat_time_after_the_handover_and_walking_starts_standing(followed):
    _, env, course, switches = followed
    for s in switches:
        if s.target == WALK:
            assert s.state["standing"] == 1 and not s.state["command"].any() and s.state["steps"] == 0
        else:
            assert s.state["command_step"] == round(SQUAT_TIME / env.step_dt) and s.state["steps"] == 0
    jumps = course.switch_step >= 0
    assert jumps.sum() == 4
    assert ((course.takeoff_step - course.switch_step)[jumps] * env.step_dt > SQUAT_TIME).all()
    first = switches[[s.target for s in switches].index(JUMP_TO)]
    way = first.state["goal"][:2] - first.after[:2]
    assert np.linalg.norm(way) == pytest.approx(0.7 if first.world else np.hypot(0.6, 0.1), abs=1e-5)


def mass_of(*trained, **conditions):
    """Return the base mass [kg] of the robot of three skills, trained with overlays of base masses [kg] or without."""
    policies = SkillRun()
    robots = [None if mass is None else RobotOverlay({"base_mass": (mass,)}, source="bench") for mass in trained]
    policies.recipes = [replace(recipe, robot=robot) for recipe, robot in zip(policies.recipes, robots, strict=True)]
    policies.conditions = Conditions(device="cpu", **conditions)
    return float(policies.env(1).sim.model.body_mass.numpy()[0])


def test_skills_have_the_robot_of_their_training_unless_it_differs(tmp_path, capfd):
    assert mass_of(8.0, 8.0, 8.0) == pytest.approx(8.0)
    assert "overlay" not in capfd.readouterr().err
    assert mass_of(None, 8.0, None) == pytest.approx(8.0)
    line = "jumper: the robot has the overlay of vertical_jump; walking and horizontal_jump were trained without"
    assert line in capfd.readouterr().err.splitlines()
    with pytest.raises(PolicyError, match=r"walking and horizontal_jump .* different robots.* --robot FILE"):
        mass_of(8.0, None, 7.0)
    RobotOverlay({"base_mass": (9.0,)}).save(tmp_path / "robot.json")
    assert mass_of(8.0, None, 7.0, robot=tmp_path / "robot.json") == pytest.approx(9.0)

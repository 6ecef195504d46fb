"""Several tasks (skills) in one environment: one active skill per world, and handovers between them."""

import dataclasses

import numpy as np
import pytest
import torch
import warp as wp

import hold_height
from columns import Z
from hold_height import HoldState
from jump_helpers import random_actions
from jumper_warp.envs.env import Env
from jumper_warp.kernels.mdp.view import RobotView
from jumper_warp.registry import make_task
from jumper_warp.tasks.cfg import Handover
from jumper_warp.tasks.randomization import RandomizationCfg
from skill_helpers import begin_hold, begin_jump, hold_requested, jump_requested
from velocity_helpers import edit

N = 16
DEG = np.pi / 180.0
JUMP = dataclasses.replace(make_task("vertical-jump"), action_scale=(40.0, 90.0))
HOLD = dataclasses.replace(hold_height.hold_height(), action_scale=(40.0, 40.0))
AGAIN = dataclasses.replace(HOLD, name="hold-again")
SKILL = np.arange(N) % 3 == 1


@wp.func
def always(robot: RobotView, state: HoldState, requested: bool) -> bool:
    """Begin the next skill at once, whether requested or not."""
    return True


@wp.func
def keep_holding(robot: RobotView, state: HoldState) -> HoldState:
    """Return the state of the next skill: the same."""
    return state


TO_JUMP = Handover(HOLD, JUMP, jump_requested, begin_jump)
TO_HOLD = Handover(JUMP, HOLD, hold_requested, begin_hold)


def make(*tasks, **arguments) -> Env:
    """Return a reset environment of N worlds with a skill for each task; arguments: of `Env`."""
    env = Env(tasks if len(tasks) > 1 else tasks[0], N, **({"seed": 5, "device": "cpu"} | arguments))
    env.reset()
    return env


def parameters_of(env) -> dict[str, np.ndarray]:
    """Return the randomised parameters by name; the world is the last index."""
    parameters, motors = env.parameters, env.sim.motors
    names = ("kp", "kd", "saturation", "peak", "no_load_speed", "cutoff_speed", "offset")
    found = {name: getattr(motors, name).numpy().copy() for name in names}
    found |= {name: getattr(parameters, name).numpy().copy() for name in ("latency", "observation_latency")}
    found |= {"push": parameters.push.numpy().T.copy()}
    return found | {"table": env.sim.dynamics.robot.table.numpy().copy()}


def coordinates(env) -> np.ndarray:
    """Return joint_q and joint_qd of each world side by side, (N, 81)."""
    return np.concatenate([env.sim.joint_q(), env.sim.joint_qd()], axis=1)


# ---------------------------------------------------------------- without handovers


@pytest.mark.parametrize("nominal", [False, True], ids=["drawn", "nominal"])
@pytest.mark.parametrize("index", [0, 1])
def test_worlds_of_a_skill_equal_those_of_an_environment_with_one_skill_bitwise(index, nominal):
    """Actions of a skill in worlds of the other skill are NaN."""
    arguments = {"randomize": not nominal, "noise": not nominal}
    both = make(JUMP, HOLD, skill=SKILL.astype(int), **arguments)
    alone = make(both.tasks[index], **arguments)
    mine = np.flatnonzero(index == SKILL)
    ended = np.zeros(N)
    for step, action in enumerate(0.5 * random_actions(N, 220)):
        actions = torch.full((2, N, 12), torch.nan)
        actions[index, mine] = action[mine]
        actions[1 - index, index != SKILL] = 0.0
        both.step(actions)
        alone.step(action)
        skill, expected = both.skills[index], alone.skills[0]
        for group in ("actor", "critic"):
            for kind in ("obs", "final_obs"):
                found, wanted = (getattr(each, kind)[group][mine] for each in (skill, expected))
                assert torch.equal(found, wanted), (step, group, kind)
        for name in ("reward", "done", "timeout"):
            assert torch.equal(getattr(both, name)[mine], getattr(alone, name)[mine]), (step, name)
        np.testing.assert_array_equal(coordinates(both)[mine], coordinates(alone)[mine])
        assert (skill.states.numpy()[mine] == expected.states.numpy()[mine]).all()
        for name, values in parameters_of(both).items():
            np.testing.assert_array_equal(values[..., mine], parameters_of(alone)[name][..., mine], err_msg=name)
        ended += both.done.numpy()
    assert (ended[mine] > 0).all() and not skill.metrics()["Metrics/bad_actions"]
    np.testing.assert_array_equal(both.episodes.skill.numpy(), SKILL)


def test_every_skill_counts_its_own_terminations():
    env = make(JUMP, HOLD, skill=SKILL.astype(int))
    ended = np.zeros(N)
    for action in random_actions(N, 130):
        env.step(action.repeat(2, 1, 1))
        ended += env.done.numpy()
    for index, skill in enumerate(env.skills):
        counted = skill.counters.termination_count.numpy().sum(axis=0)
        np.testing.assert_array_equal(counted, np.where(index == SKILL, ended, 0.0))


# ---------------------------------------------------------------- handovers

CHOSEN = np.arange(N) < 6  # worlds in which a handover is requested


def followed(env, actions, request_at=None, skill=0, worlds=CHOSEN):
    """Step with the same action for every skill; return coordinates and skills after every step.

    A handover to `skill` is requested in `worlds` before step `request_at`.
    """
    trace, skills = [], []
    for step, action in enumerate(actions):
        if step == request_at:
            env.request(skill, worlds)
        env.step(action.repeat(len(env.skills), 1, 1))
        trace.append(coordinates(env).copy())
        skills.append(env.episodes.skill.numpy().copy())
    return np.array(trace), np.array(skills)


def test_worlds_with_a_request_switch_once_and_others_never():
    env = make(JUMP, HOLD, skill=1, handovers=(TO_JUMP, TO_HOLD))
    trace, skills = followed(env, 0.2 * random_actions(N, 12), request_at=5)
    assert (skills[:5] == 1).all() and (skills[5:] == ~CHOSEN).all()
    assert (env.episodes.requested_task.numpy() == -1).all() and not env.done.any()
    states = env.skills[0].states.numpy()
    assert (states["steps"][CHOSEN] == 6).all() and not states["steps"][~CHOSEN].any()
    np.testing.assert_allclose(states["start"][CHOSEN], trace[5, CHOSEN, :3])
    np.testing.assert_allclose(states["goal"][CHOSEN, 2], 0.6 + env.skills[1].states.numpy()["goal"][CHOSEN], rtol=1e-6)


def test_a_handover_changes_neither_the_robot_nor_other_worlds():
    """The reference is an equal environment without requests."""
    env, reference = (make(JUMP, HOLD, skill=1, handovers=(TO_JUMP, TO_HOLD)) for _ in range(2))
    for step, action in enumerate(0.3 * random_actions(N, 40)):
        if step == 5:
            env.request(0, CHOSEN)
        for each in (env, reference):
            each.step(action.repeat(2, 1, 1))
        if step == 5:  # the step of the handover
            np.testing.assert_array_equal(coordinates(env), coordinates(reference))
        for name, values in parameters_of(env).items():
            unchanged = slice(None) if name in ("table", "offset", "latency", "observation_latency") else ~CHOSEN
            if step <= 5:
                np.testing.assert_array_equal(values[..., unchanged], parameters_of(reference)[name][..., unchanged])
        rest = ~CHOSEN
        np.testing.assert_array_equal(coordinates(env)[rest], coordinates(reference)[rest])
        assert torch.equal(env.reward[rest], reference.reward[rest])
        assert torch.equal(env.skills[1].obs["actor"][rest], reference.skills[1].obs["actor"][rest])
    assert (coordinates(env)[CHOSEN] != coordinates(reference)[CHOSEN]).any()  # other motors, filter and scales


def test_a_handover_between_skills_with_equal_motors_changes_no_motion():
    """Masses, latencies and pushes do not change, so equal targets give bitwise equal motions."""
    there = Handover(HOLD, AGAIN, jump_requested, keep_holding)
    back = Handover(AGAIN, HOLD, jump_requested, keep_holding)
    actions = 0.1 * random_actions(N, 10)
    reference, env = (make(HOLD, AGAIN, handovers=(there, back)) for _ in range(2))
    expected, _ = followed(reference, actions)
    found, skills = followed(env, actions, request_at=3, skill=1)
    assert (skills[3:] == CHOSEN).all() and not env.done.any() and not reference.done.any()
    np.testing.assert_array_equal(found, expected)
    for name, values in parameters_of(reference).items():
        np.testing.assert_array_equal(parameters_of(env)[name], values, err_msg=name)


def test_a_handover_changes_motors_filter_and_scales_and_keeps_sampled_ratios():
    task = dataclasses.replace(JUMP, motors=dataclasses.replace(
        JUMP.motors, transversal=dataclasses.replace(JUMP.motors.transversal, kp=30.0, no_load_speed=35.0))
    )  # fmt: skip
    still = RandomizationCfg.walking()
    hold = dataclasses.replace(
        HOLD, events=(), randomization=dataclasses.replace(still, push_force=None, push_torque=None)
    )
    env = make(task, hold, skill=1, handovers=(Handover(hold, task, jump_requested, begin_jump),))
    before, action = parameters_of(env), torch.zeros((2, N, 12))
    action[:, :, ::3] = 1.0  # lateral
    env.step(action)
    np.testing.assert_allclose(env.robot.filtered_target.numpy()[::3], 40.0 * DEG, rtol=1e-6)
    env.request(0, CHOSEN)
    env.step(action)
    assert not env.done.any()
    held = env.robot.filtered_target.numpy() - env.robot.default_angle.numpy()[:, None]
    scale = np.tile([40.0, 90.0, 90.0], 4)[:, None] * DEG
    np.testing.assert_allclose(env.robot.action.numpy()[:, CHOSEN], (held / scale)[:, CHOSEN], atol=1e-6)
    after = parameters_of(env)
    for name, values in after.items():
        switched = name in ("kp", "kd", "saturation", "no_load_speed", "cutoff_speed")
        np.testing.assert_array_equal(values[..., ~CHOSEN], before[name][..., ~CHOSEN], err_msg=name)
        if not switched:
            np.testing.assert_array_equal(values, before[name], err_msg=name)
    for name in ("kp", "kd", "no_load_speed", "saturation"):
        old, new = (
            np.tile([getattr(motors.lateral, name), *2 * [getattr(motors.transversal, name)]], 4)[:, None]
            for motors in (hold.motors, task.motors)
        )
        np.testing.assert_allclose(after[name][:, CHOSEN] / new, before[name][:, CHOSEN] / old, rtol=1e-5, err_msg=name)
    assert (after["cutoff_speed"] <= 0.95 * after["no_load_speed"] + 1e-5).all()
    env.step(action)
    lateral = env.robot.filtered_target.numpy()[::3] / DEG
    np.testing.assert_allclose(env.robot.target.numpy()[::3], 40.0 * DEG, rtol=1e-6)
    near = lateral[:, CHOSEN] < 15.0 + 1e-4  # the filter acts near the limit
    assert near.mean() > 0.3 and (np.abs(lateral[:, CHOSEN][~near] - 40.0) < 1e-4).all()
    assert (np.abs(lateral[:, ~CHOSEN] - 40.0) < 1e-4).all()


def test_a_new_skill_observes_nothing_from_before_the_handover():
    """Observation history and delayed terms are cleared, also for a skill that was active in the world earlier."""
    env = make(JUMP, HOLD, skill=1, handovers=(TO_JUMP, TO_HOLD), noise=False)
    first, end = HOLD.layout("actor")["height"]
    actions = 0.3 * random_actions(N, 30)
    followed(env, actions[:8], request_at=5)  # to jumping
    old_obs = env.skills[1].obs["actor"].clone()
    followed(env, actions[8:15], request_at=6, skill=1)  # and back
    assert (env.episodes.skill.numpy() == 1).all() and not env.done.any()
    seen = env.skills[1].obs["actor"][CHOSEN, first:end].numpy()
    height = env.sim.joint_q()[CHOSEN, 2]
    np.testing.assert_allclose(seen, np.repeat(5.0 * height[:, None], 3, axis=1), rtol=1e-5)
    assert (seen != old_obs[CHOSEN, first:end].numpy()).all()
    followed(env, actions[15:16])
    following = env.skills[1].obs["actor"][CHOSEN, first:end].numpy()
    np.testing.assert_array_equal(following[:, :2], seen[:, 1:])
    last_first, last_end = HOLD.layout("actor")["last_action"]
    np.testing.assert_array_equal(env.skills[1].obs["actor"][CHOSEN, last_first:last_end], actions[15][CHOSEN])


def test_a_world_switches_at_most_once_a_step_and_not_when_its_episode_ends():
    handovers = (Handover(HOLD, AGAIN, always, keep_holding), Handover(AGAIN, HOLD, always, keep_holding))
    env = make(HOLD, AGAIN, handovers=handovers)
    edit(env, 2, steps=119)  # the episode ends in this step, and the next one has the same skill
    skills = followed(env, torch.zeros((5, N, 12)))[1]
    rest = np.arange(N) != 2
    assert (skills[:, rest] == np.array([1, 0, 1, 0, 1])[:, None]).all()
    assert skills[:, 2].tolist() == [0, 1, 0, 1, 0]


def test_an_environment_with_handovers_continues_bitwise_from_a_saved_state():
    saved, fresh = (make(JUMP, HOLD, skill=1, handovers=(TO_JUMP, TO_HOLD)) for _ in range(2))
    actions = 0.3 * random_actions(N, 60)
    followed(saved, actions[:12], request_at=5)
    saved.request(1, CHOSEN)
    fresh.load_state_dict(saved.state_dict())
    for found, expected in zip(followed(fresh, actions[12:]), followed(saved, actions[12:]), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert torch.equal(fresh.reward, saved.reward) and (saved.episodes.skill.numpy() == 1).all()


def test_a_command_in_the_request_is_given_at_the_handover():
    env = make(JUMP, HOLD, skill=1, handovers=(TO_JUMP, TO_HOLD), randomize=False, noise=False)
    followed(env, torch.zeros((3, N, 12)))
    commands = np.zeros((N, 3))
    commands[:, Z] = np.linspace(0.6, 0.9, N)
    env.request(0, CHOSEN, commands)
    env.request(0, np.arange(N) == 7)
    followed(env, torch.zeros((1, N, 12)))
    states = env.skills[0].states.numpy()
    np.testing.assert_allclose(states["goal"][CHOSEN, 2], commands[CHOSEN, 2], rtol=1e-6)
    assert (states["command_step"][CHOSEN] == 0).all() and states["command_step"][7] == 1000
    first, _ = JUMP.layout("actor")["wanted_height"]
    np.testing.assert_allclose(env.skills[0].obs["actor"][CHOSEN, first], commands[CHOSEN, 2], rtol=1e-6)
    assert not env.episodes.has_command.numpy()[CHOSEN].any() and (env.episodes.skill.numpy()[8:] == 1).all()


@pytest.mark.parametrize("begin", ["reset", "reset with a seed", "evaluation_reset", "ended"])
def test_new_episodes_begin_in_the_first_skill_without_requests(begin):
    """In the case "ended" one episode ends by its termination; other worlds do not change."""
    env, fresh = (make(JUMP, HOLD, skill=1, handovers=(TO_JUMP, TO_HOLD), randomize=False) for _ in range(2))
    followed(env, torch.zeros((3, N, 12)), request_at=1)
    env.request(1, np.arange(N) == 4, np.ones((N, 1)))
    new = np.full(N, True)
    if begin.startswith("reset"):
        env.reset(seed=5 if "seed" in begin else None)
    elif begin == "evaluation_reset":
        env.evaluation_reset(np.full((N, 1), 0.3))
    else:
        new = np.arange(N) == 3
        edit(env, 3, steps=10_000)  # too long
        env.request(1, new)
        followed(env, torch.zeros((1, N, 12)))
        assert env.done[3]
    assert (env.episodes.skill.numpy()[new] == 1).all() and (env.episodes.requested_task.numpy()[new] == -1).all()
    assert not env.episodes.has_command.numpy()[new].any()
    assert (env.episodes.skill.numpy()[(~new) & CHOSEN & (np.arange(N) != 4)] == 0).all()
    for name, values in parameters_of(fresh).items():
        np.testing.assert_array_equal(parameters_of(env)[name][..., new], values[..., new], err_msg=name)


def test_metrics_and_configuration_contain_all_skills():
    env = make(JUMP, HOLD, skill=SKILL.astype(int), handovers=(TO_JUMP, TO_HOLD))
    followed(env, 0.5 * random_actions(N, 130))
    metrics, config = env.metrics(), env.config()
    assert "Episode_Reward/jump_height" in metrics and "hold-height/Episode_Reward/near_goal" in metrics
    assert sum(v for k, v in metrics.items() if k.startswith("hold-height/Episode_Termination")) == pytest.approx(1.0)
    assert config["first_skill"] == SKILL.astype(int).tolist()
    assert config["handovers"][0]["when"].endswith(":jump_requested")


@pytest.mark.parametrize(
    ("make_env", "message"),
    [
        (lambda: Env([HOLD, HOLD], N), "unique names, got .*'hold-height', 'hold-height'"),
        (lambda: Env([JUMP, HOLD], N, skill=2), "skill must be an index below 2, got 2 to 2"),
        (lambda: Env([JUMP, make_task("horizontal-jump")], N, handovers=[TO_JUMP]), "hold-height to vertical-jump"),
        (lambda: make(JUMP, HOLD).step(torch.zeros((N, 12))), r"shape \(2, 16, 12\), got \(16, 12\)"),
    ],
)
def test_refuses_invalid_skills(make_env, message):
    with pytest.raises(ValueError, match=message):
        make_env()

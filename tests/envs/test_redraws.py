"""Times at which parameters are sampled, and effects of sampled parameters."""

import dataclasses

import numpy as np
import pytest
import torch

from columns import Z
from jump_helpers import DEG, edit_episodes, make_env, only, random_actions, resetting
from jumper_warp.evaluation.jumps import paw_arrays
from jumper_warp.kernels.jump.state import LANDED
from jumper_warp.tasks.randomization import RandomizationCfg
from randomization_helpers import ALL, HELD, OFF, ROWS, TASK, fills, own_model, randomized, read, seen, within


@pytest.fixture(scope="module")
def nominal():
    """Return the parameters with every row off."""
    return read(randomized(OFF))


# ---------------------------------------------------------------- times


def test_samples_start_from_the_nominal_values_at_every_reset(nominal):
    env = randomized(RandomizationCfg(**ALL, **HELD))
    before = read(env)
    for _ in range(3):
        env.reset()
    after = read(env)
    reference = {name: values[..., :1] for name, values in nominal.items()}
    for row, value in ROWS.items():
        assert not np.array_equal(value(before, reference), value(after, reference)), row
        assert within(value(after, reference), *ALL[row]), row


@pytest.mark.parametrize("solver", ["jumper", "mujoco"])
def test_a_world_samples_parameters_at_its_resets_only(solver):
    """Some episodes end during 30 steps of random actions."""
    env = randomized(RandomizationCfg(**ALL, **HELD), 12, solver=solver)
    ended = np.zeros(12, dtype=bool)
    for step, action in enumerate(random_actions(12, 30)):
        before, of_solver = seen(env), own_model(env)
        if step % 10 == 9:
            edit_episodes(env, step // 10, phase=LANDED, phase_steps=59)
        env.step(action)
        after, done = seen(env), env.done.numpy() == 1.0
        for name in before:
            changed = (before[name] != after[name]).reshape(-1, 12).any(axis=0)
            np.testing.assert_array_equal(changed & ~done, False, err_msg=name)
            if name not in ("latency", "observation_latency"):  # integers may repeat
                np.testing.assert_array_equal(changed, done, err_msg=name)
        for name, values in own_model(env).items():
            changed = (values != of_solver[name]).reshape(12, -1).any(axis=1)
            np.testing.assert_array_equal(changed, done, err_msg=name)
        ended |= done
    assert ended[:3].all() and not ended.all()


@pytest.mark.parametrize("solver", ["jumper", "mujoco"])
def test_parameters_sampled_at_startup_do_not_change(solver):
    env = randomized(RandomizationCfg(**ALL, **HELD, resample_at="startup"), 4, solver=solver)
    first, of_solver = seen(env), own_model(env)
    assert len(np.unique(env.sim.model.body_mass.numpy())) == 84
    for action in random_actions(4, 3):
        edit_episodes(env, slice(0, 2), phase=LANDED, phase_steps=59)
        env.step(action)
        assert env.done[:2].all()
    env.reset()
    found = seen(env)
    for name in first:
        if name in ("push_force", "push_torque"):  # pushes are sampled at every reset
            assert not np.array_equal(found[name], first[name])
        else:
            np.testing.assert_array_equal(found[name], first[name], err_msg=name)
    for name, values in own_model(env).items():
        np.testing.assert_array_equal(values, of_solver[name], err_msg=name)


def test_an_evaluation_samples_parameters_of_its_worlds_only():
    env = randomized(RandomizationCfg(**ALL, **HELD), 6)
    before, chosen = read(env), np.arange(6) % 2 == 0
    env.evaluation_reset(np.zeros((6, 4)), worlds=chosen)
    after = read(env)
    for name in ("link_mass", "kp", "joint_offset", "push_force"):
        changed = (before[name] != after[name]).any(axis=0)
        np.testing.assert_array_equal(changed, chosen, err_msg=name)


@pytest.mark.parametrize(("cfg", "newton"), [(RandomizationCfg.walking(), 10.0), (RandomizationCfg(), 5.0)])
def test_a_push_acts_with_probability_0_25_in_intervals_of_0_2_to_0_5_s(cfg, newton):
    """Pushes of walking robots also act in flight, those of jumping robots only with a paw in contact."""
    task = dataclasses.replace(TASK, randomization=cfg)
    env = make_env(48, task=resetting(task, only("default")), randomize=True)
    env.auto_reset = False
    pushes, acting, was_down = [], [], np.full((48, 1), cfg.push_in_flight)
    for _ in range(300):
        env.step(torch.zeros((48, 12)))
        pushes.append(env.parameters.push.numpy().copy())
        down = (paw_arrays(env)["paws_down"].any(axis=1) | cfg.push_in_flight)[:, None]
        acting.append(env.sim.state.body_f.numpy().reshape(48, 21, 6)[:, 0])
        np.testing.assert_array_equal(acting[-1], np.where(was_down, pushes[-2:][0], 0.0))
        was_down = down
    pushes = np.array(pushes)
    on = pushes.any(axis=2)
    assert 0.2 < on.mean() < 0.3
    longest, changes = 0, 0
    for world in range(48):
        edges = np.flatnonzero((pushes[1:, world] != pushes[:-1, world]).any(axis=1))
        gaps = np.diff(edges)  # [policy steps]
        assert gaps.min(initial=12) >= 12
        lasted = [gap for gap, at in zip(gaps, edges, strict=False) if on[at + 1, world]]
        longest, changes = max([longest, *lasted]), changes + len(edges)
    assert longest <= 30 and changes > 200
    found = pushes[on]
    assert fills(found[:, :3], -newton, newton) and fills(found[:, 3:], -3.0, 3.0)


# ---------------------------------------------------------------- effects


def test_a_push_increases_momentum_by_force_times_time():
    """The robot is in the air, with contact times set as if it were standing."""
    env = randomized(OFF, 2)
    push = np.zeros((2, 6))
    push[1, :3] = [4.0, -3.0, 5.0]
    env.parameters.push.assign(push.astype(np.float32))
    q = env.sim.joint_q().copy()
    q[:, Z] += 0.5
    env.sim.state.joint_q.assign(q.ravel())
    env.robot.contact_time.fill_(1.0)
    env.step(torch.zeros((2, 12)))
    env.sim.write_bodies()
    velocity = env.sim.state.body_qd.numpy().reshape(2, 21, 6)[..., :3].astype(float)
    momentum = (env.sim.model.body_mass.numpy().reshape(2, 21, 1) * velocity).sum(axis=1)
    np.testing.assert_allclose(momentum[1] - momentum[0], np.array([4.0, -3.0, 5.0]) / 60.0, atol=2e-3)


def test_a_sensor_offset_acts_on_the_motor_and_on_the_observation():
    """A motor whose sensor reads d too high moves like an exact one whose target is d lower."""
    offset_env, exact_env = randomized(OFF, 1), randomized(OFF, 1)
    offset = np.zeros((12, 1), dtype=np.float32)
    offset[4] = 2.0 * DEG
    offset_env.parameters.motors.offset.assign(offset)
    action = torch.zeros((1, 12))
    lower = action.clone()
    lower[0, 4] = -2.0 / 90.0
    for _ in range(20):
        offset_env.step(action)
        exact_env.step(lower)
    np.testing.assert_allclose(offset_env.sim.joint_q(), exact_env.sim.joint_q(), atol=1e-4)
    _, end = offset_env.task.layout("actor")["angle"]
    difference = (offset_env.obs - exact_env.obs)[0, end - 12 : end].numpy()
    np.testing.assert_allclose(difference, offset[:, 0], atol=1e-4)


def test_motor_and_observation_use_the_same_sensor_offset():
    env = randomized(RandomizationCfg(), 2)
    assert env.sim.motors.offset.ptr == env.robot.joint_offset.ptr == env.parameters.motors.offset.ptr
    assert env.sim.motors.offset.numpy().all()

import numpy as np
import pytest

from jumper_warp.kernels.mdp.env import BEGUN
from mdp_helpers import STEP_DT, write
from probe_task import Probe, probe_task

N = 64
NAMES = ["first", "second", "third", "diverged", "too_long"]  # terminations of the probe task
FIRST, SECOND, THIRD, DIVERGED = range(4)
NONE = -1
GROWTH = 0.25  # increase of the state's value in a policy step


@pytest.fixture
def probe():
    """Return N worlds of the probe task."""
    return Probe(N)


def random_state(probe, seed=0):
    """Write random states; return (value, other, base height [m]) after the next step, (N,) each."""
    rng = np.random.default_rng(seed)
    value, other, height = rng.normal(size=N), rng.normal(size=N), rng.uniform(0.2, 1.0, N)
    write(probe.robot.joint_q, slice(2, None, 43), height)
    probe.write(value=value, other=other)
    return (value + GROWTH).astype(np.float32), other.astype(np.float32), height.astype(np.float32)


def expected_rewards(value, other, height):
    """Return the probe task's weighted reward terms as written here in NumPy, (rewards, N)."""
    return np.array(
        [3.0 * value * STEP_DT, -0.5 * 2.0 * (value - 1.5) ** 2 * STEP_DT, 4.0 * other, 10.0 * height * STEP_DT]
    )


def endings(probe):
    """Return the name of each world's termination in the last step, "" if none."""
    return [NAMES[i] if i >= 0 else "" for i in probe.world("termination")]


def test_rewards_are_weighted_and_scaled_by_dt_unless_turned_off(probe):
    expected = expected_rewards(*random_state(probe))
    probe.step()
    np.testing.assert_allclose(probe.skill.term_value.numpy(), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(probe.world("reward"), expected.sum(axis=0), rtol=1e-5, atol=1e-5)
    assert expected.sum(axis=0).min() < -1.0


def test_reward_floor_bounds_the_total_but_not_the_terms():
    probe = Probe(N, probe_task(reward_floor=-1.0))
    expected = expected_rewards(*random_state(probe))
    probe.step()
    total = expected.sum(axis=0)
    assert 0 < np.count_nonzero(total < -1.0) < N
    np.testing.assert_allclose(probe.world("reward"), np.maximum(total, -1.0), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(probe.skill.term_value.numpy(), expected, rtol=1e-5, atol=1e-6)


def test_changed_weights_and_parameters_act_in_the_next_step(probe):
    state = random_state(probe)
    probe.skill.set("rewards", "value", weight=-7.0)
    probe.skill.set("rewards", "offset_square", offset=0.5)
    probe.step()
    expected = expected_rewards(*state)
    expected[0] *= -7.0 / 3.0
    expected[1] = -0.5 * 2.0 * (state[0] - 0.5) ** 2 * STEP_DT
    np.testing.assert_allclose(probe.skill.term_value.numpy(), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_a_nonfinite_term_counts_0_in_the_reward_and_the_metrics(probe, number):
    _, other, height = random_state(probe)
    probe.write(value=np.where(np.arange(N) < 5, number, 1.0))
    probe.step()
    expected = expected_rewards(np.full(N, 1.0 + GROWTH), other, height)
    expected[:2, :5] = 0.0
    np.testing.assert_allclose(probe.world("reward"), expected.sum(axis=0), rtol=1e-5, atol=1e-5)
    is_finite = np.isfinite(probe.skill.term_value.numpy())
    assert not is_finite[:2, :5].any() and is_finite[:2, 5:].all() and is_finite[2:].all()
    end_episode(probe)
    sums = probe.skill.counters.term_sum.numpy()
    assert np.isfinite(sums).all() and sums[:2].any() and sums[2].all()
    assert all(map(np.isfinite, probe.skill.metrics().values()))


def test_a_total_that_overflows_counts_as_0(probe):
    """The finite terms 3.396e38 and 0.055e38 sum to more than the largest float, 3.403e38."""
    random_state(probe)
    probe.write(value=1.1 - GROWTH, other=np.where(np.arange(N) < 5, 8.49e37, 1.0))
    write(probe.skill.params.values, probe.task.params.index("rewards.value.weight"), 3.0e38)
    probe.step()
    reward = probe.world("reward")
    assert np.isfinite(probe.skill.term_value.numpy()).all() and not reward[:5].any() and (reward[5:] > 5.0e36).all()


def test_sums_over_episodes_are_exact_beyond_single_precision(probe):
    write(probe.skill.counters.term_sum, slice(None), 2.0**27)
    write(probe.skill.counters.error_sum, slice(None), 2.0**27)
    for error in (0.0, 0.0, 0.5, 1.5):
        end_episode(probe, error=error)
    np.testing.assert_array_equal(probe.skill.counters.error_sum.numpy(), 2.0**27 + 2.0)
    end_episode(probe, error=3.0, other=0.0)  # no success
    np.testing.assert_array_equal(probe.skill.counters.error_sum.numpy(), 2.0**27 + 2.0)
    sums = probe.skill.counters.term_sum.numpy()
    np.testing.assert_array_equal(sums[2], 2.0**27 + 4 * 44.0)


def test_episode_reward_is_the_mean_sum_of_ended_episodes_over_the_time_limit(probe):
    """Worlds 0 to 31 end in the third step; episodes of worlds 16 to 31 were restarted after the first step."""
    rewards = []
    for step in range(3):
        state = random_state(probe, seed=step)
        ends = (step == 2) & (np.arange(N) < 32)
        probe.write(other=np.where(ends, 101.0, state[1]))
        if step == 1:
            write(probe.episodes.history_reset, slice(16, 32), BEGUN)
        probe.step()
        rewards.append(expected_rewards(state[0], np.where(ends, 101.0, state[1]), state[2]))
    sums = np.array(rewards)[:, :, :32].sum(axis=0)
    sums[:, 16:] -= rewards[0][:, 16:32]
    expected = sums.mean(axis=1) / (100.0 * STEP_DT)  # [s] of too_long
    metrics = probe.skill.metrics()
    names = [f"Episode_Reward/{term.name}" for term in probe.task.rewards]
    np.testing.assert_allclose([metrics[name] for name in names], expected, rtol=1e-5)
    end_episode(probe, other=101.0)  # the others still have the sums of their whole episodes
    ended = expected_rewards(np.zeros(N), np.full(N, 101.0), state[2])
    ended[:, 32:] += np.array(rewards)[:, :, 32:].sum(axis=0)
    metrics = probe.skill.metrics()
    np.testing.assert_allclose(
        [metrics[name] for name in names], ended.mean(axis=1) / (100.0 * STEP_DT), rtol=1e-5, atol=1e-6
    )


def test_a_task_without_a_time_limit_logs_mean_episode_sums():
    probe = Probe(N, probe_task(terminations=probe_task().terminations[:-1]))
    state = random_state(probe)
    probe.write(other=101.0)
    probe.step()
    expected = expected_rewards(state[0], np.full(N, 101.0), state[2]).mean(axis=1)
    metrics = probe.skill.metrics()
    assert not any(name.startswith("Episode_Reward/") for name in metrics)
    sums = [metrics[f"Episode_Sum/{term.name}"] for term in probe.task.rewards]
    np.testing.assert_allclose(sums, expected, rtol=1e-5)


def test_terminations_read_the_state_after_its_update(probe):
    random_state(probe)
    probe.write(value=1.0, other=0.0, steps=np.where(np.arange(N) < 7, 99, 98))
    probe.step()
    np.testing.assert_array_equal(probe.read("value"), 1.25)
    np.testing.assert_array_equal(probe.read("steps"), np.where(np.arange(N) < 7, 100, 99))
    assert endings(probe) == ["too_long"] * 7 + [""] * (N - 7)


def test_a_step_changes_nothing_in_worlds_of_another_skill(probe):
    random_state(probe)
    away = np.arange(N) % 3 == 0
    probe.episodes.skill.assign(np.where(away, 1, 0))
    probe.write(other=2.0e3)
    for name in ("reward", "done", "timeout", "termination", "diverged"):
        write(getattr(probe.episodes, name), slice(None), 5)
    before = probe.skill.states.numpy().copy()
    probe.step()
    np.testing.assert_array_equal(probe.skill.states.numpy()[away], before[away])
    assert (probe.read("steps")[~away] == 1).all()
    for name in ("reward", "done", "timeout", "termination", "diverged"):
        values = probe.world(name)
        assert (values[away] == 5).all() and (values[~away] != 5).all(), name
    assert not probe.skill.counters.termination_count.numpy()[:, away].any()


@pytest.mark.parametrize(
    ("other", "termination", "time_out"),
    [(5.0, NONE, False), (11.0, THIRD, True), (101.0, SECOND, True), (1001.0, FIRST, False)],
)
def test_the_first_termination_that_holds_ends_the_episode(probe, other, termination, time_out):
    probe.write(other=other)
    probe.step()
    done = termination != NONE
    assert (probe.world("termination") == termination).all() and (probe.world("done") == float(done)).all()
    assert (probe.world("timeout") == float(time_out)).all() and (probe.world("truncated") == time_out).all()
    assert (probe.world("terminated") == (done and not time_out)).all()
    counted = probe.skill.counters.termination_count.numpy()
    expected = np.zeros((5, N))
    if done:
        expected[termination] = 1
    np.testing.assert_array_equal(counted, expected)


def make_diverge(probe, cause, world):
    """Make a world diverge; cause: "diverged" (solver's flag), "action", "fast" (15.1 m/s up) or "nan" (an angle)."""
    if cause == "diverged":
        write(probe.robot.diverged, world, 1)
    elif cause == "action":
        write(probe.episodes.bad_action, world, 1)
    elif cause == "fast":
        write(probe.robot.joint_qd, 38 * world + 2, 15.1)
    else:
        write(probe.robot.joint_q, 43 * world + 8, np.nan)


@pytest.mark.parametrize("cause", ["diverged", "action", "fast", "nan"])
@pytest.mark.parametrize("other", [0.0, 2.0e3])
def test_a_diverged_world_ends_as_diverged_and_reward_0(probe, cause, other):
    probe.write(value=1.0, other=other)
    make_diverge(probe, cause, 3)
    probe.step()
    others = np.delete(np.arange(N), 3)
    assert (
        probe.world("termination")[3] == DIVERGED
        and (probe.world("termination")[others] == (FIRST if other else NONE)).all()
    )
    assert probe.world("terminated")[3] and not probe.world("truncated")[3]
    assert probe.world("reward")[3] == 0.0 and (probe.world("reward")[others] != 0.0).all()
    assert not probe.skill.term_value.numpy()[:, 3].any() and not probe.skill.counters.term_sum.numpy()[:, 3].any()
    assert probe.world("diverged").tolist() == (np.arange(N) == 3).astype(int).tolist()
    assert not probe.world("bad_action").any()
    np.testing.assert_array_equal(probe.skill.counters.bad_actions.numpy(), (np.arange(N) == 3) * (cause == "action"))


def end_episode(probe, error=0.0, other=11.0, counts=1):
    """End an episode in every world: other > 10 is a success, > 100 a time-out, > 1000 a failure.

    error: curriculum error at the end (tolerance 2); counts: whether the curriculum counts the episode.
    """
    write(probe.episodes.done, slice(None), 0.0)  # of the last episode
    probe.write(value=error - GROWTH, other=other, counts=counts, steps=0)
    probe.step()


def test_three_successes_in_a_row_raise_the_level_up_to_past_the_last(probe):
    for number in range(1, 10):
        end_episode(probe)
        assert (probe.world("level") == min(number // 3, 2)).all()
        assert (probe.world("streak") == number % 3).all()
    np.testing.assert_array_equal(probe.skill.counters.curriculum_episodes.numpy(), 9)
    np.testing.assert_array_equal(probe.skill.counters.curriculum_successes.numpy(), 9)


@pytest.mark.parametrize(
    "failure",
    [{"error": 2.01}, {"other": 101.0}, {"other": 1001.0}],
    ids=["far", "time out without success", "failure"],
)
def test_an_episode_without_success_clears_the_streak(probe, failure):
    end_episode(probe)
    end_episode(probe)
    end_episode(probe, **failure)
    assert not probe.world("level").any() and not probe.world("streak").any()
    assert (probe.skill.counters.curriculum_episodes.numpy() == 3).all() and (
        probe.skill.counters.curriculum_successes.numpy() == 2
    ).all()
    for _ in range(3):
        end_episode(probe)
    assert (probe.world("level") == 1).all()


def test_episodes_that_do_not_count_change_neither_level_nor_streak(probe):
    end_episode(probe)
    end_episode(probe, counts=0)
    end_episode(probe, counts=0, other=1001.0)
    assert (probe.world("streak") == 1).all() and (probe.skill.counters.curriculum_episodes.numpy() == 1).all()
    assert (probe.skill.counters.termination_count.numpy().sum(axis=0) == 3).all()


def test_changed_tolerance_and_promote_after_act_in_the_next_step(probe):
    probe.skill.set("curriculum", "value", tolerance=0.5, promote_after=1)
    end_episode(probe, error=0.6)
    assert not probe.world("level").any()
    end_episode(probe, error=0.4)
    assert (probe.world("level") == 1).all()

import numpy as np
import pytest

from jumper_warp.kernels.mdp.env import COMMANDED
from mdp_helpers import write
from probe_task import Probe

N = 49
POLICY = {"value": [0], "both": [1, 2, 3, 4, 5, 6], "late": [7, 8]}
"""Columns of the actor's terms of the probe task: `both` has three frames (oldest first) of (value, other).

The critic's columns are other, latency, and two frames of the delayed value.
"""
NOISE, SCALE, CLIP = 0.5, 10.0, 4.0  # of the actor's term `value`
DEPTH = 8
"""Policy steps in the ring buffer of observations."""


@pytest.fixture
def probe():
    """Return N worlds at the start of an episode, without noise."""
    probe = Probe(N)
    probe.skill.set("observations.actor", "value", noise=0.0)
    probe.episodes.history_reset.fill_(1)
    return probe


def sequence(steps, seed=0):
    """Return random state fields `value` and `other`, (steps, N) each."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(2, steps, N)).astype(np.float32)


def observe_steps(probe, values, others):
    """Write the states and observe in every policy step; return actor and critic group, (steps, N, columns) each."""
    policy, critic = [], []
    for value, other in zip(values, others, strict=True):
        probe.write(value=value, other=other)
        probe.observe()
        policy.append(probe.obs("actor"))
        critic.append(probe.obs("critic"))
        probe.next_clock()
    return np.array(policy), np.array(critic)


def test_groups_hold_their_terms_in_order_before_and_after_resets(probe):
    probe.parameters.latency.assign(np.arange(N))
    probe.write(value=np.arange(N) / 16.0, other=-np.arange(N) / 32.0)
    probe.observe()
    value, other = np.arange(N) / 16.0, -np.arange(N) / 32.0
    expected = np.stack([10.0 * value, *3 * [value, other], value, other], axis=1)
    np.testing.assert_array_equal(probe.obs("actor"), expected.astype(np.float32))
    np.testing.assert_array_equal(probe.obs("critic"), np.stack([other, np.arange(N), value, value], axis=1))
    np.testing.assert_array_equal(probe.obs("actor", final=True), probe.obs("actor"))


def noise_of(probe):
    """Return the noise over its standard deviation at the present step count, (N,)."""
    probe.skill.set("observations.actor", "value", noise=1.0, scale=1.0, clip=100.0)
    probe.write(value=0.0)
    probe.observe()
    return probe.obs("actor")[:, 0].copy()


def test_noise_is_added_before_clipping_and_the_scale_applied_after(probe):
    noise = noise_of(probe)
    assert np.abs(noise).max() == 1.0 and np.ptp(noise) > 1.5
    probe.skill.set("observations.actor", "value", noise=NOISE, scale=SCALE, clip=CLIP)
    value = np.linspace(-5.0, 5.0, N).astype(np.float32)
    probe.write(value=value)
    probe.observe()
    expected = SCALE * np.clip(value + NOISE * noise, -CLIP, CLIP)
    np.testing.assert_allclose(probe.obs("actor")[:, 0], expected, rtol=1e-6)
    assert 2 < np.count_nonzero(np.abs(expected) == SCALE * CLIP) < N - 10


def test_noise_changes_in_every_step_and_repeats_at_the_same_step_count(probe):
    first = noise_of(probe)
    probe.next_clock()
    second = noise_of(probe)
    assert np.abs(np.corrcoef(first, second)[0, 1]) < 0.6 and (first != second).mean() > 0.5
    probe.episodes.step_count.assign(probe.episodes.step_count.numpy() - 1)
    np.testing.assert_array_equal(noise_of(probe), first)


def test_history_shifts_by_one_frame_per_step_and_starts_filled_with_the_first_frame(probe):
    values, others = sequence(6)
    policy, critic = observe_steps(probe, values, others)
    for step in range(6):
        for age in range(3):
            frame = max(step - age, 0)
            column = 1 + 2 * (2 - age)  # the oldest frame first
            np.testing.assert_array_equal(policy[step, :, column], values[frame])
            np.testing.assert_array_equal(policy[step, :, column + 1], others[frame])
        np.testing.assert_array_equal(critic[step, :, 2], values[max(step - 1, 0)])
        np.testing.assert_array_equal(critic[step, :, 3], values[step])


def begin_episodes(probe, worlds, value, other):
    """Begin an episode with these state fields in worlds (indices), and observe again after the reset."""
    probe.episodes.history_reset.assign(np.isin(np.arange(N), worlds).astype(int))
    states = probe.skill.states.numpy().copy()
    states["value"][worlds], states["other"][worlds] = value, other
    probe.write(value=states["value"], other=states["other"])
    probe.observe(after_reset=1)


def test_a_reset_fills_the_history_with_the_new_frame_and_keeps_final_observations(probe):
    values, others = sequence(5)
    policy, critic = observe_steps(probe, values, others)
    chosen, rest = np.arange(0, N, 4), np.setdiff1d(np.arange(N), np.arange(0, N, 4))
    begin_episodes(probe, chosen, 7.5, -7.5)
    now, final = probe.obs("actor"), probe.obs("actor", final=True)
    np.testing.assert_array_equal(final, policy[-1])
    np.testing.assert_array_equal(probe.obs("critic", final=True), critic[-1])
    np.testing.assert_array_equal(now[rest], policy[-1, rest])
    np.testing.assert_array_equal(now[chosen][:, POLICY["both"]], np.tile([7.5, -7.5], (len(chosen), 3)))
    np.testing.assert_array_equal(now[chosen][:, POLICY["late"]], np.tile([7.5, -7.5], (len(chosen), 1)))
    np.testing.assert_array_equal(probe.obs("critic")[chosen][:, 2:], 7.5)
    probe.next_clock()
    again, _ = observe_steps(probe, values[:1], others[:1])
    np.testing.assert_array_equal(again[0][chosen][:, [1, 2, 3, 4]], np.tile([7.5, -7.5], (len(chosen), 2)))
    np.testing.assert_array_equal(again[0][rest][:, [1, 2, 3, 4]], policy[-1][rest][:, [3, 4, 5, 6]])


def test_a_delayed_term_is_interpolated_linearly_between_past_frames(probe):
    """Worlds have latencies of 0 to 48 physics steps (1/8 policy step each); `np.interp` is the oracle."""
    latency = np.arange(N)
    probe.latency.assign(latency)
    values, others = sequence(24)
    policy, critic = observe_steps(probe, values, others)
    times = np.arange(24)
    for world in range(N):
        when = times - latency[world] / 8.0  # [policy steps] the first frame holds before step 0
        for column, observed in ((7, values), (8, others)):
            expected = np.interp(when, times, observed[:, world].astype(float))
            np.testing.assert_allclose(policy[:, world, column], expected, atol=2e-6)
        late = np.interp(when, times, values[:, world].astype(float))
        np.testing.assert_allclose(critic[:, world, 3], late, atol=2e-6)
        np.testing.assert_array_equal(critic[1:, world, 2], critic[:-1, world, 3])
    np.testing.assert_array_equal(policy[..., 5], values)  # others are not delayed


def test_a_delayed_term_holds_nothing_of_the_previous_episode(probe):
    probe.latency.fill_(48)  # 6 policy steps
    observe_steps(probe, *sequence(10))
    begin_episodes(probe, np.arange(N), 3.25, 4.25)
    probe.next_clock()
    policy, _ = observe_steps(probe, *sequence(DEPTH - 2, seed=1))
    np.testing.assert_array_equal(policy[..., 7], 3.25)
    np.testing.assert_array_equal(policy[..., 8], 4.25)


def test_a_command_within_an_episode_replaces_the_newest_frame_only(probe):
    probe.latency.fill_(0)
    values, others = sequence(5)
    policy, critic = observe_steps(probe, values, others)
    probe.episodes.step_count.assign(probe.episodes.step_count.numpy() - 1)  # of the last observation
    chosen, rest = np.arange(0, N, 4), np.setdiff1d(np.arange(N), np.arange(0, N, 4))
    probe.episodes.history_reset.assign(np.isin(np.arange(N), chosen) * int(COMMANDED))
    probe.write(value=7.5, other=-7.5)
    for _ in range(2):  # the second observation must change nothing
        probe.observe(after_reset=1)
        now, final = probe.obs("actor"), probe.obs("actor", final=True)
        np.testing.assert_array_equal(final, policy[-1])
        np.testing.assert_array_equal(now[rest], policy[-1, rest])
        np.testing.assert_array_equal(now[chosen][:, [1, 2, 3, 4]], policy[-1, chosen][:, [1, 2, 3, 4]])
        np.testing.assert_array_equal(now[chosen][:, [5, 6, 7, 8]], np.tile([7.5, -7.5], (len(chosen), 2)))
        np.testing.assert_array_equal(probe.obs("critic")[chosen][:, 2], critic[-1, chosen][:, 2])
    probe.next_clock()
    probe.episodes.history_reset.zero_()
    probe.latency.fill_(8)
    again, _ = observe_steps(probe, values[:1], others[:1])
    np.testing.assert_array_equal(again[0][chosen][:, [3, 4, 7, 8]], np.tile([7.5, -7.5], (len(chosen), 2)))
    np.testing.assert_array_equal(again[0][chosen][:, [1, 2]], policy[-1, chosen][:, [3, 4]])


def test_diverged_worlds_observe_0_in_all_frames_and_only_new_frames_after_a_reset(probe):
    probe.skill.set("observations.actor", "value", noise=1.0)
    probe.latency.fill_(12)
    observe_steps(probe, *sequence(4))
    diverged = np.arange(N) % 5 == 0
    probe.episodes.diverged.assign(diverged.astype(int))
    write(probe.robot.joint_q, slice(0, 43), np.nan)  # all coordinates of world 0
    probe.write(value=np.where(diverged, np.nan, 1.0), other=np.where(diverged, np.inf, 1.0))
    probe.observe()
    for group in ("actor", "critic"):
        for final in (False, True):
            observed = probe.obs(group, final)
            assert np.isfinite(observed).all() and not observed[diverged].any()
            assert observed[~diverged, 1:].any()
    probe.episodes.diverged.zero_()
    begin_episodes(probe, np.flatnonzero(diverged), value=0.5, other=0.25)
    frames = probe.obs("actor")[diverged][:, 1:]
    np.testing.assert_array_equal(frames, np.tile([0.5, 0.25], (diverged.sum(), 4)))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_nonfinite_value_is_observed_as_0_and_changes_no_other_column(probe, bad):
    probe.latency.fill_(4)  # half a policy step
    values, others = sequence(3)
    values[1, 5] = bad
    policy, critic = observe_steps(probe, values, others)
    assert np.isfinite(policy).all() and np.isfinite(critic).all()
    assert not policy[1, 5, [0, 5]].any() and policy[1, 5, 6] == others[1, 5]
    assert policy[2, 5, 7] == pytest.approx(0.5 * values[2, 5])


def test_observations_of_worlds_of_another_skill_do_not_change(probe):
    away = np.arange(N) % 3 == 0
    observe_steps(probe, *sequence(3))
    before = {group: probe.obs(group) for group in ("actor", "critic")}
    past = probe.skill.observations.past.numpy().copy()
    probe.episodes.skill.assign(away.astype(int))
    observe_steps(probe, *sequence(1, seed=1))
    for group, observed in before.items():
        np.testing.assert_array_equal(probe.obs(group)[away], observed[away])
        assert (probe.obs(group)[~away] != observed[~away]).any(axis=1).all()
    np.testing.assert_array_equal(probe.skill.observations.past.numpy()[:, away], past[:, away])

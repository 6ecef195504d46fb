import numpy as np
import pytest

from jumper_warp.kernels.mdp.env import COMMANDED
from mdp_helpers import write
from probe_task import Probe

N = 49
POLICY = {"value": [0], "both": [1, 2, 3, 4, 5, 6], "late": [7, 8]}
"""Columns of the policy's terms: one frame, three frames of two, and one delayed frame of two."""
NOISE, SCALE, CLIP = 0.5, 10.0, 4.0
DEPTH = 8
"""Policy steps that are remembered."""


@pytest.fixture
def probe():
    """Worlds whose first observation has no past; exact."""
    probe = Probe(N)
    probe.skill.set("observations.actor", "value", noise=0.0)
    probe.episodes.history_reset.fill_(1)
    return probe


def sequence(steps, seed=0):
    """Return values and others of every world and step, (steps, N) each."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(2, steps, N)).astype(np.float32)


def play(probe, values, others):
    """Observe every world after each step; return both groups, (steps, N, columns) each."""
    policy, critic = [], []
    for value, other in zip(values, others, strict=True):
        probe.write(value=value, other=other)
        probe.observe()
        policy.append(probe.obs("actor"))
        critic.append(probe.obs("critic"))
        probe.next_clock()
    return np.array(policy), np.array(critic)


def test_terms_follow_each_other_in_their_groups(probe):
    probe.parameters.latency.assign(np.arange(N))
    probe.write(value=np.arange(N) / 16.0, other=-np.arange(N) / 32.0)
    probe.observe()
    value, other = np.arange(N) / 16.0, -np.arange(N) / 32.0
    expected = np.stack([10.0 * value, *3 * [value, other], value, other], axis=1)
    np.testing.assert_array_equal(probe.obs("actor"), expected.astype(np.float32))
    np.testing.assert_array_equal(probe.obs("critic"), np.stack([other, np.arange(N), value, value], axis=1))
    np.testing.assert_array_equal(probe.obs("actor", final=True), probe.obs("actor"))


def noise_of(probe):
    """Return the noise of each world over its standard deviation, as it comes at the present clock."""
    probe.skill.set("observations.actor", "value", noise=1.0, scale=1.0, clip=100.0)
    probe.write(value=0.0)
    probe.observe()
    return probe.obs("actor")[:, 0].copy()


def test_noise_comes_before_the_clipping_and_the_scale_after(probe):
    noise = noise_of(probe)
    assert np.abs(noise).max() == 1.0 and np.ptp(noise) > 1.5
    probe.skill.set("observations.actor", "value", noise=NOISE, scale=SCALE, clip=CLIP)
    value = np.linspace(-5.0, 5.0, N).astype(np.float32)
    probe.write(value=value)
    probe.observe()
    expected = SCALE * np.clip(value + NOISE * noise, -CLIP, CLIP)
    np.testing.assert_allclose(probe.obs("actor")[:, 0], expected, rtol=1e-6)
    assert 2 < np.count_nonzero(np.abs(expected) == 40.0) < N - 10


def test_noise_is_another_in_every_step_and_the_same_again_at_the_same_clock(probe):
    first = noise_of(probe)
    probe.next_clock()
    second = noise_of(probe)
    assert np.abs(np.corrcoef(first, second)[0, 1]) < 0.6 and (first != second).mean() > 0.5
    probe.episodes.step_count.assign(probe.episodes.step_count.numpy() - 1)
    np.testing.assert_array_equal(noise_of(probe), first)


def test_terms_without_noise_are_exact_beside_noisy_ones(probe):
    probe.skill.set("observations.actor", "value", noise=1.0)
    values, others = sequence(4)
    policy, critic = play(probe, values, others)
    np.testing.assert_array_equal(policy[..., 5], values)
    np.testing.assert_array_equal(critic[..., 0], others)


def test_history_shifts_by_a_frame_a_step_and_begins_with_the_first_frame_everywhere(probe):
    values, others = sequence(6)
    policy, critic = play(probe, values, others)
    for step in range(6):
        for age in range(3):
            frame = max(step - age, 0)
            columns = 1 + 2 * (2 - age)  # the oldest first
            np.testing.assert_array_equal(policy[step, :, columns], values[frame])
            np.testing.assert_array_equal(policy[step, :, columns + 1], others[frame])
        np.testing.assert_array_equal(critic[step, :, 2], values[max(step - 1, 0)])
        np.testing.assert_array_equal(critic[step, :, 3], values[step])


def begin_some(probe, worlds, value, other):
    """Begin an episode in some worlds after a step, as an environment does."""
    probe.episodes.history_reset.assign(np.isin(np.arange(N), worlds).astype(int))
    states = probe.skill.states.numpy().copy()
    states["value"][worlds], states["other"][worlds] = value, other
    probe.write(value=states["value"], other=states["other"])
    probe.observe(after_reset=1)


def test_a_new_episode_has_no_past_and_the_last_observation_keeps_that_of_the_old_one(probe):
    values, others = sequence(5)
    policy, critic = play(probe, values, others)
    some, rest = np.arange(0, N, 4), np.setdiff1d(np.arange(N), np.arange(0, N, 4))
    begin_some(probe, some, 7.5, -7.5)
    now, final = probe.obs("actor"), probe.obs("actor", final=True)
    np.testing.assert_array_equal(final, policy[-1])
    np.testing.assert_array_equal(probe.obs("critic", final=True), critic[-1])
    np.testing.assert_array_equal(now[rest], policy[-1, rest])
    np.testing.assert_array_equal(now[some][:, POLICY["both"]], np.tile([7.5, -7.5], (len(some), 3)))
    np.testing.assert_array_equal(now[some][:, POLICY["late"]], np.tile([7.5, -7.5], (len(some), 1)))
    np.testing.assert_array_equal(probe.obs("critic")[some][:, 2:], 7.5)
    probe.next_clock()
    again, _ = play(probe, values[:1], others[:1])
    np.testing.assert_array_equal(again[0][some][:, [1, 2, 3, 4]], np.tile([7.5, -7.5], (len(some), 2)))
    np.testing.assert_array_equal(again[0][rest][:, [1, 2, 3, 4]], policy[-1][rest][:, [3, 4, 5, 6]])


def test_a_delayed_term_is_on_the_straight_line_between_past_frames(probe):
    """One latency a world, from 0 to 48 physics steps of 1/8 policy step."""
    latency = np.arange(N)
    probe.latency.assign(latency)
    values, others = sequence(24)
    policy, critic = play(probe, values, others)
    times = np.arange(24)
    for world in range(N):
        when = times - latency[world] / 8.0  # before the first frame all was as in it
        for column, seen in ((7, values), (8, others)):
            expected = np.interp(when, times, seen[:, world].astype(float))
            np.testing.assert_allclose(policy[:, world, column], expected, atol=2e-6)
        late = np.interp(when, times, values[:, world].astype(float))
        np.testing.assert_allclose(critic[:, world, 3], late, atol=2e-6)
        np.testing.assert_array_equal(critic[1:, world, 2], critic[:-1, world, 3])
    np.testing.assert_array_equal(policy[..., 5], values)  # others are not delayed


def test_whole_policy_steps_of_delay_give_frames_bit_for_bit(probe):
    probe.latency.assign(8 * (np.arange(N) % 7))
    values, others = sequence(12)
    policy, _ = play(probe, values, others)
    for world in range(N):
        frames = np.maximum(np.arange(12) - world % 7, 0)
        np.testing.assert_array_equal(policy[:, world, 7], values[frames, world])


def test_a_new_episode_sees_nothing_of_the_old_one_however_late(probe):
    probe.latency.fill_(48)
    play(probe, *sequence(10))
    begin_some(probe, np.arange(N), 3.25, 4.25)
    probe.next_clock()
    policy, _ = play(probe, *sequence(DEPTH - 2, seed=1))
    np.testing.assert_array_equal(policy[..., 7], 3.25)
    np.testing.assert_array_equal(policy[..., 8], 4.25)


def test_a_command_within_an_episode_renews_the_newest_frame_and_keeps_those_before(probe):
    """The terms of commanded worlds are seen again, as if the step had given them; the others stay as they are."""
    probe.latency.fill_(0)
    values, others = sequence(5)
    policy, critic = play(probe, values, others)
    probe.episodes.step_count.assign(probe.episodes.step_count.numpy() - 1)  # as after the last step
    some, rest = np.arange(0, N, 4), np.setdiff1d(np.arange(N), np.arange(0, N, 4))
    probe.episodes.history_reset.assign(np.isin(np.arange(N), some) * int(COMMANDED))
    probe.write(value=7.5, other=-7.5)
    for _ in range(2):  # a second time changes nothing
        probe.observe(after_reset=1)
        now, final = probe.obs("actor"), probe.obs("actor", final=True)
        np.testing.assert_array_equal(final, policy[-1])
        np.testing.assert_array_equal(now[rest], policy[-1, rest])
        np.testing.assert_array_equal(now[some][:, [1, 2, 3, 4]], policy[-1, some][:, [1, 2, 3, 4]])
        np.testing.assert_array_equal(now[some][:, [5, 6, 7, 8]], np.tile([7.5, -7.5], (len(some), 2)))
        np.testing.assert_array_equal(probe.obs("critic")[some][:, 2], critic[-1, some][:, 2])
    probe.next_clock()
    probe.episodes.history_reset.zero_()
    probe.latency.fill_(8)
    again, _ = play(probe, values[:1], others[:1])
    np.testing.assert_array_equal(again[0][some][:, [3, 4, 7, 8]], np.tile([7.5, -7.5], (len(some), 2)))
    np.testing.assert_array_equal(again[0][some][:, [1, 2]], policy[-1, some][:, [3, 4]])


def test_broken_worlds_read_0_in_all_frames_and_go_on_without_a_trace(probe):
    probe.skill.set("observations.actor", "value", noise=1.0)
    probe.latency.fill_(12)
    play(probe, *sequence(4))
    diverged = np.arange(N) % 5 == 0
    probe.episodes.diverged.assign(diverged.astype(int))
    write(probe.robot.joint_q, slice(0, 43), np.nan)
    probe.write(value=np.where(diverged, np.nan, 1.0), other=np.where(diverged, np.inf, 1.0))
    probe.observe()
    for group in ("actor", "critic"):
        for final in (False, True):
            seen = probe.obs(group, final)
            assert np.isfinite(seen).all() and not seen[diverged].any() and (np.abs(seen[~diverged, 1:]) > 0).any()
    probe.episodes.diverged.zero_()
    begin_some(probe, np.flatnonzero(diverged), 0.5, 0.25)
    found = probe.obs("actor")[diverged][:, 1:]
    np.testing.assert_array_equal(found, np.tile([0.5, 0.25], (diverged.sum(), 4)))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_reads_0_and_leaves_the_rest_alone(probe, bad):
    probe.latency.fill_(4)
    values, others = sequence(3)
    values[1, 5] = bad
    policy, critic = play(probe, values, others)
    assert np.isfinite(policy).all() and np.isfinite(critic).all()
    assert not policy[1, 5, [0, 5]].any() and policy[1, 5, 6] == others[1, 5]
    assert policy[2, 5, 7] == pytest.approx(0.5 * values[2, 5])


def test_worlds_of_another_skill_are_passed_over(probe):
    away = np.arange(N) % 3 == 0
    play(probe, *sequence(3))
    before = {group: probe.obs(group) for group in ("actor", "critic")}
    past = probe.skill.observations.past.numpy().copy()
    probe.episodes.skill.assign(away.astype(int))
    play(probe, *sequence(1, seed=1))
    for group, seen in before.items():
        np.testing.assert_array_equal(probe.obs(group)[away], seen[away])
        assert (probe.obs(group)[~away] != seen[~away]).any(axis=1).all()
    np.testing.assert_array_equal(probe.skill.observations.past.numpy()[:, away], past[:, away])

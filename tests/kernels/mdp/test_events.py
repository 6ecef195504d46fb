import dataclasses

import numpy as np
import pytest
import torch
import warp as wp

from jump_helpers import edit_episodes, make_env, random_actions
from jumper_warp.kernels.mdp.events import AT_RESET, AT_STEP, STARTUP
from jumper_warp.kernels.mdp.parameters import RobotParameters
from jumper_warp.kernels.mdp.random import RngStream, uniform
from jumper_warp.registry import make_task
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.terms import EventTerm
from mdp_helpers import STEP_DT, array
from probe_task import Probe, probe_task

N = 256


@wp.func
def count(robot: RobotParameters, rng: RngStream, times: float):
    """Count in the latency how often the event ran."""
    robot.latency[rng.world] = robot.latency[rng.world] + int(times)


@wp.func
def mark(robot: RobotParameters, rng: RngStream):
    """Count in the latency of observations."""
    robot.observation_latency[rng.world] = robot.observation_latency[rng.world] + 1


@wp.func
def drawn_force(robot: RobotParameters, rng: RngStream, lower: float, upper: float):
    """Draw a force."""
    robot.push[rng.world] = wp.spatial_vector(uniform(rng, 0, lower, upper), 0.0, 0.0, 0.0, 0.0, 0.0)


EVENTS = (
    EventTerm(count, name="start", mode="startup", times=1.0),
    EventTerm(count, name="begin", mode="reset", times=1000.0),
    EventTerm(mark, mode="interval", interval_range_s=(4.0 * STEP_DT, 9.0 * STEP_DT)),
    EventTerm(mark, name="regular", mode="interval", interval_range_s=(3.0 * STEP_DT, 3.0 * STEP_DT)),
    EventTerm(drawn_force, mode="reset", lower=2.0, upper=3.0),
)
REGULAR = 3
LANES = 3
"""Threads for each event, of which those that are not spread use one."""


class Events(Probe):
    """Worlds with events, and launches of them; `only`: names of those that the task has."""

    def __init__(self, only, seed=0):
        super().__init__(N, probe_task(events=tuple(e for e in EVENTS if e.name in only.split())), seed=seed)
        self.parameters.observation_latency = array(np.zeros(N), int)
        self.parameters.push = wp.zeros(N, dtype=wp.spatial_vector, device="cpu")

    def run(self, stage, mask=1.0):
        """Launch the events of a stage where mask is not 0."""
        skill, mask = self.skill, array(np.broadcast_to(np.asarray(mask, dtype=float), N))
        inputs = [skill.index, stage, 0, LANES, mask, STEP_DT, self.episodes, skill.params.values, skill.timer,
                  self.parameters]  # fmt: skip
        wp.launch(skill.kernels["event"], (skill.num_events, LANES, N), inputs, device="cpu")

    def event_counts(self):
        """Return how often the counting events ran at the start, and at resets."""
        found = self.parameters.latency.numpy()
        return found % 1000, found // 1000

    def marked(self):
        """Return how often an interval event ran."""
        return self.parameters.observation_latency.numpy().copy()


@pytest.fixture
def counting():
    return Events("start begin")


def test_each_stage_runs_its_own_events(counting):
    counting.run(STARTUP)
    assert [set(found) for found in counting.event_counts()] == [{1}, {0}]
    counting.run(AT_RESET)
    counting.run(AT_STEP)
    counting.run(AT_RESET)
    assert [set(found) for found in counting.event_counts()] == [{1}, {2}]


def test_a_reset_runs_in_the_masked_worlds_only(counting):
    mask = np.arange(N) % 3 == 0
    counting.run(AT_RESET, mask)
    np.testing.assert_array_equal(counting.event_counts()[1], mask)


def test_worlds_of_another_skill_are_passed_over(counting):
    away = np.arange(N) % 3 == 0
    counting.episodes.skill.assign(away.astype(int))
    for stage in (STARTUP, AT_RESET, AT_STEP):
        counting.run(stage)
    started, begun = counting.event_counts()
    np.testing.assert_array_equal(started, ~away)
    np.testing.assert_array_equal(begun, ~away)


def test_numbers_of_an_event_change_while_it_runs(counting):
    counting.run(STARTUP)
    counting.skill.set("events", "start", times=7.0)
    counting.run(STARTUP)
    assert set(counting.event_counts()[0]) == {8}


def gaps_of(events, steps):
    """Begin, and return the steps at which each world's event ran, (steps, N) bool."""
    events.run(STARTUP)
    assert not events.marked().any()
    events.run(AT_RESET)
    ran, before = [], events.marked()
    assert (before == 1).all()  # at the beginning too
    for _ in range(steps):
        events.next_clock()
        events.run(AT_STEP)
        ran.append(events.marked() - before)
        before = events.marked()
    return np.array(ran)


def test_intervals_are_uniform_between_least_and_most_in_every_world():
    ran = gaps_of(Events("mark"), 100)
    assert set(ran.ravel()) == {0, 1}
    gaps = [np.diff(np.concatenate([[0], np.flatnonzero(ran[:, world]) + 1])) for world in range(N)]
    every = np.concatenate(gaps)
    assert set(every) == set(range(4, 10))
    # rounded to whole steps: the ends have half a step each
    shares = np.bincount(every, minlength=10)[4:] / len(every)
    np.testing.assert_allclose(shares, [0.1, 0.2, 0.2, 0.2, 0.2, 0.1], atol=4.5 * np.sqrt(0.16 / len(every)))
    firsts, seconds = np.array([gap[0] for gap in gaps]), np.array([gap[1] for gap in gaps])
    assert abs(np.corrcoef(firsts[1:], firsts[:-1])[0, 1]) < 5.0 / np.sqrt(N)
    assert abs(np.corrcoef(firsts, seconds)[0, 1]) < 5.0 / np.sqrt(N)


def test_a_regular_interval_is_met_exactly():
    ran = gaps_of(Events("regular"), 30)
    np.testing.assert_array_equal(ran, np.tile((np.arange(1, 31) % 3 == 0)[:, None], (1, N)))


def test_a_reset_runs_an_interval_event_and_starts_its_interval_anew():
    events = Events("regular")
    events.run(AT_RESET)
    for _ in range(2):
        events.next_clock()
        events.run(AT_STEP)
    some = np.arange(N) % 2 == 0
    events.run(AT_RESET, some)
    np.testing.assert_array_equal(events.marked(), 1 + some)
    ran = []
    for _ in range(4):
        events.next_clock()
        before = events.marked()
        events.run(AT_STEP)
        ran.append(events.marked() - before)
    np.testing.assert_array_equal(np.array(ran), np.where(some, [[0], [0], [1], [0]], [[1], [0], [0], [1]]))


def test_an_interval_that_no_reset_began_starts_with_the_first_step():
    """As in a world that was handed over to the skill."""
    events, ran = Events("regular"), []
    for _ in range(7):
        events.next_clock()
        before = events.marked()
        events.run(AT_STEP)
        ran.append(set(events.marked() - before))
    assert ran == [{0}, {0}, {0}, {1}, {0}, {0}, {1}]


def test_an_interval_shorter_than_a_step_comes_in_every_step():
    events = Events("regular")
    events.skill.params.set("events.regular.interval_range_s.lower", 0.1 * STEP_DT)
    events.skill.params.set("events.regular.interval_range_s.upper", 0.2 * STEP_DT)
    assert (gaps_of(events, 5) == 1).all()


def test_draws_follow_seed_and_clock_and_nothing_else():
    def forces(only, seed=0, steps=0):
        events = Events(only, seed)
        for _ in range(steps):
            events.next_clock()
        events.run(AT_RESET)
        return events.parameters.push.numpy()[:, 0].copy()

    first = forces("drawn_force")
    assert first.min() >= 2.0 and first.max() < 3.0 and len(np.unique(first)) == N
    np.testing.assert_array_equal(forces("drawn_force"), first)
    for other in (forces("drawn_force", seed=1), forces("drawn_force", steps=1)):
        assert abs(np.corrcoef(first, other)[0, 1]) < 5.0 / np.sqrt(N)


WALKING = dataclasses.replace(RandomizationCfg.walking(), push_interval=(0.05, 0.1), push_probability=0.7)


def test_a_replayed_graph_draws_the_same_bits_as_single_launches():
    task = dataclasses.replace(make_task("vertical-jump"), randomization=WALKING)
    replayed, single = (make_env(16, task=task, randomize=True, noise=True, seed=5) for _ in range(2))
    pushes = []
    for step, action in enumerate(0.5 * random_actions(16, 40, seed=6)):
        if step % 9 == 4:  # some episodes end, and draw anew
            for env in (replayed, single):
                edit_episodes(env, [step % 16, (step + 3) % 16], steps=5000)
        replayed.step(action)
        single.action.copy_(action)
        single._launch_step()
        for name in ("obs", "critic_obs", "final_obs", "reward", "done"):
            assert torch.equal(getattr(replayed, name), getattr(single, name)), (step, name)
        for name in ("push", "latency", "body_mass", "shape_mu", "gain_ratio"):
            values = [getattr(env.parameters, name).numpy() for env in (replayed, single)]
            np.testing.assert_array_equal(*values, name)
        pushes.append(replayed.parameters.push.numpy().copy())
    assert replayed._graphs and not single._graphs
    pushes = np.array(pushes)
    changes = (pushes[1:] != pushes[:-1]).any(axis=2).sum(axis=0)
    assert changes.min() >= 3 and len(set(changes)) > 1

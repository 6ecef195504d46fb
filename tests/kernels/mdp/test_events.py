import dataclasses

import numpy as np
import pytest
import torch
import warp as wp

from jump_helpers import edit_episodes, make_env, random_actions
from jumper_warp.kernels.mdp.events import AT_RESET, AT_STEP, STARTUP
from jumper_warp.kernels.mdp.parameters import RobotParameters
from jumper_warp.kernels.mdp.random import RngStream
from jumper_warp.registry import make_task
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.terms import EventTerm
from mdp_helpers import STEP_DT, array
from probe_task import Probe, probe_task

N = 256


@wp.func
def count_run(robot: RobotParameters, rng: RngStream, times: float):
    """Add `times` to the world's latency, which counts runs of the event."""
    robot.latency[rng.world] = robot.latency[rng.world] + int(times)


@wp.func
def count_interval(robot: RobotParameters, rng: RngStream):
    """Add 1 to the world's observation latency, which counts runs of interval events."""
    robot.observation_latency[rng.world] = robot.observation_latency[rng.world] + 1


EVENTS = (
    EventTerm(count_run, name="start", mode="startup", times=1.0),
    EventTerm(count_run, name="begin", mode="reset", times=1000.0),
    EventTerm(count_interval, mode="interval", interval_range_s=(4.0 * STEP_DT, 9.0 * STEP_DT)),
    EventTerm(count_interval, name="regular", mode="interval", interval_range_s=(3.0 * STEP_DT, 3.0 * STEP_DT)),
)
LANES = 3
"""Threads of each event; events without `parallel` use the first only."""


class Events(Probe):
    """N worlds of the probe task with events, and launches of their kernel."""

    def __init__(self, only, seed=0):
        """only: names in EVENTS of the task's events, separated by spaces."""
        super().__init__(N, probe_task(events=tuple(e for e in EVENTS if e.name in only.split())), seed=seed)
        self.parameters.observation_latency = array(np.zeros(N), int)
        self.parameters.push = wp.zeros(N, dtype=wp.spatial_vector, device="cpu")

    def run(self, stage, mask=1.0):
        """Launch the events of a stage (STARTUP, AT_RESET, AT_STEP) where mask, (N,) or one for all, is not 0."""
        skill, mask = self.skill, array(np.broadcast_to(np.asarray(mask, dtype=float), N))
        inputs = [skill.index, stage, 0, LANES, mask, STEP_DT, self.episodes, skill.params.values, skill.timer,
                  self.parameters]  # fmt: skip
        wp.launch(skill.kernels["event"], (skill.num_events, LANES, N), inputs, device="cpu")

    def event_counts(self):
        """Return how often `start` and `begin` ran, two arrays (N,)."""
        latency = self.parameters.latency.numpy()
        return latency % 1000, latency // 1000

    def interval_counts(self):
        """Return how often the interval event ran, (N,)."""
        return self.parameters.observation_latency.numpy().copy()


@pytest.fixture
def counting():
    """Return worlds with the events `start` and `begin`."""
    return Events("start begin")


def test_each_stage_runs_the_events_of_its_mode(counting):
    counting.run(STARTUP)
    assert [set(counts) for counts in counting.event_counts()] == [{1}, {0}]  # of start, begin
    mask = np.arange(N) % 3 == 0
    counting.run(AT_RESET)
    counting.run(AT_STEP)
    counting.run(AT_RESET, mask)
    assert set(counting.event_counts()[0]) == {1}
    np.testing.assert_array_equal(counting.event_counts()[1], 1 + mask)


def test_worlds_of_another_skill_run_no_events(counting):
    away = np.arange(N) % 3 == 0
    counting.episodes.skill.assign(away.astype(int))
    for stage in (STARTUP, AT_RESET, AT_STEP):
        counting.run(stage)
    started, begun = counting.event_counts()
    np.testing.assert_array_equal(started, ~away)
    np.testing.assert_array_equal(begun, ~away)


def test_a_changed_number_of_an_event_acts_in_its_next_run(counting):
    counting.run(STARTUP)
    counting.skill.set("events", "start", times=7.0)
    counting.run(STARTUP)
    assert set(counting.event_counts()[0]) == {8}  # 1 + 7


def interval_runs(events, steps):
    """Reset all worlds, then return how often each world's interval event ran in each policy step, (steps, N)."""
    events.run(STARTUP)
    assert not events.interval_counts().any()
    events.run(AT_RESET)
    ran, before = [], events.interval_counts()
    assert (before == 1).all()  # an interval event runs at a reset too
    for _ in range(steps):
        events.next_clock()
        events.run(AT_STEP)
        ran.append(events.interval_counts() - before)
        before = events.interval_counts()
    return np.array(ran)


def test_intervals_are_uniform_in_their_range_and_independent_across_worlds_and_runs():
    ran = interval_runs(Events("count_interval"), 100)
    assert set(ran.ravel()) == {0, 1}
    gaps = [np.diff(np.concatenate([[0], np.flatnonzero(ran[:, world]) + 1])) for world in range(N)]
    all_gaps = np.concatenate(gaps)
    assert set(all_gaps) == set(range(4, 10))
    # rounded to whole steps: the ends have half a step each
    shares = np.bincount(all_gaps, minlength=10)[4:] / len(all_gaps)
    np.testing.assert_allclose(shares, [0.1, 0.2, 0.2, 0.2, 0.2, 0.1], atol=4.5 * np.sqrt(0.16 / len(all_gaps)))
    firsts, seconds = np.array([gap[0] for gap in gaps]), np.array([gap[1] for gap in gaps])
    assert abs(np.corrcoef(firsts[1:], firsts[:-1])[0, 1]) < 5.0 / np.sqrt(N)
    assert abs(np.corrcoef(firsts, seconds)[0, 1]) < 5.0 / np.sqrt(N)


def test_a_reset_runs_an_interval_event_and_restarts_its_interval():
    events = Events("regular")
    events.run(AT_RESET)
    for _ in range(2):
        events.next_clock()
        events.run(AT_STEP)
    chosen = np.arange(N) % 2 == 0
    events.run(AT_RESET, chosen)
    np.testing.assert_array_equal(events.interval_counts(), 1 + chosen)
    ran = []
    for _ in range(4):
        events.next_clock()
        before = events.interval_counts()
        events.run(AT_STEP)
        ran.append(events.interval_counts() - before)
    np.testing.assert_array_equal(np.array(ran), np.where(chosen, [[0], [0], [1], [0]], [[1], [0], [0], [1]]))


def test_an_interval_without_a_reset_starts_with_the_first_step():
    """A world without a reset is one that was handed over to the skill."""
    events, ran = Events("regular"), []
    for _ in range(7):
        events.next_clock()
        before = events.interval_counts()
        events.run(AT_STEP)
        ran.append(set(events.interval_counts() - before))
    assert ran == [{0}, {0}, {0}, {1}, {0}, {0}, {1}]


def test_an_interval_event_shorter_than_a_policy_step_runs_in_every_step():
    events = Events("regular")
    events.skill.params.set("events.regular.interval_range_s.lower", 0.1 * STEP_DT)
    events.skill.params.set("events.regular.interval_range_s.upper", 0.2 * STEP_DT)
    assert (interval_runs(events, 5) == 1).all()


WALKING = dataclasses.replace(RandomizationCfg.walking(), push_interval=(0.05, 0.1), push_probability=0.7)


def test_a_replayed_graph_is_bitwise_equal_to_single_launches_with_randomisation():
    task = dataclasses.replace(make_task("vertical-jump"), randomization=WALKING)
    replayed, single = (make_env(16, task=task, randomize=True, noise=True, seed=5) for _ in range(2))
    pushes = []
    for step, action in enumerate(0.5 * random_actions(16, 40, seed=6)):
        if step % 9 == 4:  # two episodes end and are reset
            for env in (replayed, single):
                edit_episodes(env, [step % 16, (step + 3) % 16], steps=5000)  # beyond the time limit
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
    changes = (pushes[1:] != pushes[:-1]).any(axis=2).sum(axis=0)  # number of new pushes, by world
    assert changes.min() >= 3 and len(set(changes)) > 1

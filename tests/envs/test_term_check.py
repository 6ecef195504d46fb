"""A term that reads outside an array is found, and the others run."""

import dataclasses
import sys
from typing import Any

import pytest
import warp as wp

from hold_height import hold_height
from jumper_warp import mdp
from jumper_warp.envs.term_check import REST, check_terms


@wp.func
def outside(robot: mdp.RobotArrays, ground: mdp.Ground, world: int) -> float:
    """Return a coordinate of a world that does not exist."""
    return robot.joint_q[43 * (world + 1_000_000)]


@wp.func
def next_motor(robot: mdp.RobotView, state: Any, motor: float) -> float:
    """Return the angle of a motor after the last."""
    return robot.angle[int(motor) + 1]


def faulty() -> mdp.TaskCfg:
    """Return a task with two faulty terms, and one correct term that is not the project's."""
    task = hold_height()
    observations = mdp.ObservationsCfg(actor=(mdp.ObservationTerm(outside),), critic=())
    terminations = tuple(term for term in task.terminations if term.name != "held")
    rewards = (task.rewards[0], mdp.RewardTerm(next_motor, 1.0, motor=11.0))
    return dataclasses.replace(task, rewards=rewards, observations=observations, terminations=terminations, events=())


@pytest.mark.skipif(sys.platform != "linux", reason="signals of other systems differ")
def test_terms_that_read_outside_an_array_are_named(capfd):
    found = dict(check_terms(faulty()))
    assert list(found) == [REST, "observations.actor.outside", "rewards.near_goal", "rewards.next_motor"]
    crashed = {name for name, failure in found.items() if failure}
    assert crashed == {"rewards.next_motor", "observations.actor.outside"}
    assert all(found[name].startswith("killed by SIG") for name in crashed)
    assert capfd.readouterr().err.count("Assertion failed") == 2

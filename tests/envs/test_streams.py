"""Random streams by purpose: robots, start states and noise of an environment, and numbers sampled on the host."""

import itertools

import numpy as np
import pytest
import torch

from jumper_warp.envs.env import Env
from jumper_warp.registry import make_task
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.utils.checks import MOST_SEED
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.streams import PURPOSES, purpose_seed
from randomization_helpers import ALL, HELD, OFF, randomized, read

WHOLE = ("latency", "observation_latency")  # Parameters that are whole physics steps


@pytest.fixture(scope="module")
def robots():
    """Sampled parameters of 8 robots with the same seed, by purpose."""
    return {name: read(randomized(RandomizationCfg(**ALL, **HELD), 8, seed=3, stream=name)) for name in PURPOSES}


@pytest.mark.parametrize(("first", "second"), list(itertools.combinations(PURPOSES, 2)))
def test_purposes_sample_different_robots_with_the_same_seed(first, second, robots):
    nominal = read(randomized(OFF, 8))
    for name, values in robots[first].items():
        random, differs = (
            (values != nominal[name]) | (robots[second][name] != nominal[name]),
            values != robots[second][name],
        )
        assert random.any() and (differs.any() if name in WHOLE else differs[random].all()), name


@pytest.mark.parametrize("purpose", PURPOSES)
def test_a_purpose_repeats_bitwise_also_after_a_reset_with_its_seed(purpose, robots):
    env = randomized(RandomizationCfg(**ALL, **HELD), 8, seed=4, stream=purpose)
    assert (read(env)["base_mass"] != robots[purpose]["base_mass"]).all()
    env.reset(seed=3)
    for name, values in read(env).items():
        np.testing.assert_array_equal(values, robots[purpose][name], err_msg=name)


def test_start_states_and_observation_noise_differ_by_purpose():
    task = make_task("velocity-flat")
    one, other = (Env(task, 8, seed=3, stream=name, device="cpu", randomize=False) for name in ("tuning", "reporting"))
    assert not torch.isclose(one.reset()[0]["actor"], other.reset()[0]["actor"], rtol=0.0, atol=1e-6).all(dim=1).any()


def test_no_two_pairs_of_purpose_and_seed_have_the_same_seed():
    """The smallest and the largest seeds of purposes follow one another."""
    ends = [(purpose_seed(name, 0), purpose_seed(name, MOST_SEED)) for name in PURPOSES]
    assert ends[0] == (0, 2**31 - 1)
    assert all(last + 1 == first for (_, last), (first, _) in itertools.pairwise(ends))
    with pytest.raises(InputError, match="seed must be in 0"):
        purpose_seed("tuning", 2**31)

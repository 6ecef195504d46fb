import itertools
import math

import numpy as np
import pytest
import warp as wp
from scipy.stats import kstest

from jumper_warp.kernels.mdp.random import clamped_normal, fold_in, make_stream, uniform, uniform_range
from jumper_warp.utils.streams import PURPOSES
from mdp_helpers import array

WORLDS, COLUMNS = 4096, 8
CLAMPED_STD = math.sqrt(0.5161)
"""Standard deviation of a standard normal number clamped to [-1, 1]."""


@wp.kernel(enable_backward=False)
def draw_kernel(
    seed: int,
    purpose: int,
    worlds: wp.array(dtype=int),
    step_count: int,
    stream: int,
    branch_of: int,
    first: int,
    seeds: wp.array(dtype=wp.uint32),
    uniforms: wp.array2d(dtype=float),
    pairs: wp.array2d(dtype=float),
    normal: wp.array2d(dtype=float),
):
    """Sample numbers with indices from `first` on; branch_of: number for `fold_in`, < 0: the stream itself."""
    i = wp.tid()
    rng = make_stream(seed, purpose, worlds[i], step_count, stream)
    if branch_of >= 0:
        rng = fold_in(rng, branch_of)
    seeds[i] = rng.seed
    for j in range(uniforms.shape[1]):
        uniforms[i, j] = uniform(rng, first + j, -2.0, 3.0)
        pairs[i, j] = uniform_range(rng, first + j, wp.vec2(-2.0, 3.0))
        normal[i, j] = clamped_normal(rng, first + j)


def samples(worlds=None, seed=7, step_count=16, stream=1, branch_of=-1, first=0, columns=COLUMNS, purpose=0):
    """Return stream seeds (worlds,), uniform numbers of [-2, 3) and clamped normal ones, (worlds, columns) each."""
    worlds = np.arange(WORLDS) if worlds is None else np.asarray(worlds)
    n = len(worlds)
    seeds = wp.zeros(n, dtype=wp.uint32, device="cpu")
    arrays = [wp.zeros((n, columns), dtype=float, device="cpu") for _ in range(3)]
    wp.launch(
        draw_kernel,
        n,
        [seed, purpose, array(worlds, int), step_count, stream, branch_of, first],
        [seeds, *arrays],
        device="cpu",
    )
    uniforms, pairs, normal = (values.numpy() for values in arrays)
    np.testing.assert_array_equal(pairs, uniforms)
    return seeds.numpy(), uniforms, normal


def pcg(state):
    """Return the output of the PCG generator RXS-M-XS with 32 bits of state (O'Neill, 2014), the oracle of Warp's."""
    with np.errstate(over="ignore"):
        b = np.asarray(state, dtype=np.uint32) * np.uint32(747796405) + np.uint32(2891336453)
        c = ((b >> ((b >> np.uint32(28)) + np.uint32(4))) ^ b) * np.uint32(277803737)
        return (c >> np.uint32(22)) ^ c


def hashed(*keys):
    """Return the generator state of a seed (first key) into which further keys are hashed in order."""
    state = np.asarray(keys[0], dtype=np.uint32)
    with np.errstate(over="ignore"):
        for key in keys[1:]:
            state = pcg(state + pcg(np.asarray(key).astype(np.uint32)))
    return state


@pytest.mark.parametrize("seed", [0, 7, 2**31 - 1, -5])
def test_numbers_are_a_hash_of_seed_world_step_count_stream_and_index(seed):
    worlds = np.arange(WORLDS)
    states, uniform, _ = samples(seed=seed, step_count=123456, stream=205)
    expected = hashed(np.uint32(seed % 2**32), worlds, 123456, 205)
    np.testing.assert_array_equal(states, expected)
    columns = hashed(expected[:, None], np.arange(COLUMNS))
    unit = (pcg(columns) >> np.uint32(8)) / 2.0**24
    np.testing.assert_allclose(uniform, -2.0 + 5.0 * unit, atol=1e-6)


def test_streams_of_two_purposes_share_at_most_one_number_whatever_their_seeds():
    """States of streams s and t are equal where s - t = pcg(index of t) - pcg(index of s): once if these all differ."""
    indices = np.arange(-2, 20000)  # largest index: of an attempt to sample a start state
    starts = [(purpose * 2**28 + indices) % 2**32 for purpose in range(len(PURPOSES))]
    for first, second in itertools.combinations(starts, 2):
        differences = pcg(second) - pcg(first)
        assert len(np.unique(differences)) == len(differences)


@pytest.mark.parametrize("purpose", range(len(PURPOSES)))
def test_purposes_have_their_own_ranges_of_indices(purpose):
    states, uniform, _ = samples(purpose=purpose)
    unit = (pcg(hashed(states[:, None], purpose * 2**28 + np.arange(COLUMNS))) >> np.uint32(8)) / 2.0**24
    np.testing.assert_allclose(uniform, -2.0 + 5.0 * unit, atol=1e-6)


def test_a_number_does_not_depend_on_which_others_are_sampled():
    _, uniform, normal = samples()
    three = [5, 4000, 17]  # worlds
    for worlds, first, columns in ((np.arange(WORLDS)[::-1], 0, COLUMNS), (three, 3, 2), (three, 7, 1)):
        _, part_uniform, part_normal = samples(worlds, first=first, columns=columns)
        np.testing.assert_array_equal(part_uniform, uniform[worlds, first : first + columns])
        np.testing.assert_array_equal(part_normal, normal[worlds, first : first + columns])


CHANGES = {
    "seed": {"seed": 8},
    "purpose": {"purpose": 3},
    "step_count": {"step_count": 17},
    "far clock": {"step_count": 16 + 60 * 3600},
    "stream": {"stream": 2},
    "observation": {"stream": 200},
    "fold_in": {"branch_of": 0},
    "columns": {"first": COLUMNS},
}


def correlation(a, b):
    """Return the absolute correlation of two arrays of one shape."""
    return abs(np.corrcoef(a.ravel(), b.ravel())[0, 1])


@pytest.mark.parametrize("change", CHANGES)
def test_another_seed_step_count_stream_or_branch_gives_independent_numbers(change):
    (_, first, first_normal), (_, second, second_normal) = samples(), samples(**CHANGES[change])
    bound = 5.0 / math.sqrt(first.size)  # 5 standard errors
    assert correlation(first, second) < bound and correlation(first_normal, second_normal) < bound
    for shift in (1, 2, 3):  # neither are they numbers of other columns or worlds
        assert correlation(first[:, shift:], second[:, :-shift]) < 5.0 / math.sqrt(first.size * (1 - shift / COLUMNS))
        assert correlation(first[shift:], second[:-shift]) < bound * 1.01
    assert not (first == second).any(axis=1).all()


def test_neighbouring_worlds_and_columns_are_independent():
    _, uniform, normal = samples()
    for values in (uniform, normal):
        assert correlation(values[1:], values[:-1]) < 5.0 / math.sqrt(values.size)
        matrix = np.corrcoef(values.T) - np.eye(COLUMNS)
        assert np.abs(matrix).max() < 5.0 / math.sqrt(WORLDS)


def test_clamped_normal_numbers_have_the_clamped_gaussians_moments_and_distribution():
    _, _, normal = samples()
    cells = normal.size
    assert np.abs(normal).max() == 1.0
    assert normal.mean() == pytest.approx(0.0, abs=4.0 * CLAMPED_STD / math.sqrt(cells))
    assert normal.std() == pytest.approx(CLAMPED_STD, abs=4.0 * 0.4 / math.sqrt(cells))
    for end in (1.0, -1.0):  # beyond one sigma to either side
        assert np.mean(normal == end) == pytest.approx(0.15866, abs=4.0 * 0.366 / math.sqrt(cells))
    inside = normal[np.abs(normal) < 1.0]
    assert kstest(inside, truncated).pvalue > 1e-3


def truncated(x):
    """Return the distribution function at x of a standard normal number within [-1, 1]."""
    cdf = np.vectorize(lambda value: 0.5 * (1.0 + math.erf(value / math.sqrt(2.0))))
    return (cdf(x) - cdf(-1.0)) / (cdf(1.0) - cdf(-1.0))

import math

import numpy as np
import pytest
import warp as wp
from scipy.stats import kstest

from jumper_warp.kernels.mdp.random import clamped_normal, fold_in, make_stream, uniform, uniform_range
from mdp_helpers import array

WORLDS, COLUMNS = 4096, 8
SIGMA_OF_CUT = math.sqrt(0.5161)
"""Standard deviation of a standard normal number cut at one standard deviation."""


@wp.kernel(enable_backward=False)
def draw_kernel(
    seed: int,
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
    """Draw columns from `first` on; branch_of < 0: from the stream itself."""
    i = wp.tid()
    rng = make_stream(seed, worlds[i], step_count, stream)
    if branch_of >= 0:
        rng = fold_in(rng, branch_of)
    seeds[i] = rng.seed
    for j in range(uniforms.shape[1]):
        uniforms[i, j] = uniform(rng, first + j, -2.0, 3.0)
        pairs[i, j] = uniform_range(rng, first + j, wp.vec2(-2.0, 3.0))
        normal[i, j] = clamped_normal(rng, first + j)


def draws(worlds=None, seed=7, step_count=16, stream=1, branch_of=-1, first=0, columns=COLUMNS):
    """Return the state of each world's stream, uniform numbers of [-2, 3), and cut normal ones, (worlds, columns)."""
    worlds = np.arange(WORLDS) if worlds is None else np.asarray(worlds)
    n = len(worlds)
    seeds = wp.zeros(n, dtype=wp.uint32, device="cpu")
    found = [wp.zeros((n, columns), dtype=float, device="cpu") for _ in range(3)]
    wp.launch(
        draw_kernel, n, [seed, array(worlds, int), step_count, stream, branch_of, first], [seeds, *found], device="cpu"
    )
    uniforms, pairs, normal = (values.numpy() for values in found)
    np.testing.assert_array_equal(pairs, uniforms)
    return seeds.numpy(), uniforms, normal


def pcg(state):
    """The permuted congruential generator with 32 bits of state and of output, RXS-M-XS (O'Neill, 2014)."""
    with np.errstate(over="ignore"):
        b = np.asarray(state, dtype=np.uint32) * np.uint32(747796405) + np.uint32(2891336453)
        c = ((b >> ((b >> np.uint32(28)) + np.uint32(4))) ^ b) * np.uint32(277803737)
        return (c >> np.uint32(22)) ^ c


def hashed(*keys):
    """Return the state that follows from a seed and keys, one after the other."""
    state = np.asarray(keys[0], dtype=np.uint32)
    with np.errstate(over="ignore"):
        for key in keys[1:]:
            state = pcg(state + pcg(np.asarray(key).astype(np.uint32)))
    return state


@pytest.mark.parametrize("seed", [0, 7, 2**31 - 1, -5])
def test_numbers_are_a_hash_of_seed_world_clock_stream_and_column(seed):
    worlds = np.arange(WORLDS)
    states, uniform, _ = draws(seed=seed, step_count=123456, stream=205)
    expected = hashed(np.uint32(seed % 2**32), worlds, 123456, 205)
    np.testing.assert_array_equal(states, expected)
    columns = hashed(expected[:, None], np.arange(COLUMNS))
    unit = (pcg(columns) >> np.uint32(8)) / 2.0**24
    np.testing.assert_allclose(uniform, -2.0 + 5.0 * unit, atol=1e-6)


def test_a_number_is_the_same_whatever_else_is_drawn():
    _, uniform, normal = draws()
    some = [5, 4000, 17]
    for worlds, first, columns in ((np.arange(WORLDS)[::-1], 0, COLUMNS), (some, 3, 2), (some, 7, 1)):
        _, alone, bell = draws(worlds, first=first, columns=columns)
        np.testing.assert_array_equal(alone, uniform[worlds, first : first + columns])
        np.testing.assert_array_equal(bell, normal[worlds, first : first + columns])


OTHERS = {
    "seed": {"seed": 8},
    "step_count": {"step_count": 17},
    "far clock": {"step_count": 16 + 60 * 3600},
    "stream": {"stream": 2},
    "observation": {"stream": 200},
    "fold_in": {"branch_of": 0},
    "columns": {"first": COLUMNS},
}


def correlation(a, b):
    return abs(np.corrcoef(a.ravel(), b.ravel())[0, 1])


@pytest.mark.parametrize("other", OTHERS)
def test_another_seed_clock_stream_or_branch_gives_independent_numbers(other):
    (_, one, bell), (_, two, chime) = draws(), draws(**OTHERS[other])
    bound = 5.0 / math.sqrt(one.size)
    assert correlation(one, two) < bound and correlation(bell, chime) < bound
    for shift in (1, 2, 3):  # nor are they those of other columns or worlds
        assert correlation(one[:, shift:], two[:, :-shift]) < 5.0 / math.sqrt(one.size * (1 - shift / COLUMNS))
        assert correlation(one[shift:], two[:-shift]) < bound * 1.01
    assert not (one == two).any(axis=1).all()


def test_branches_are_independent_of_each_other():
    found = [draws(branch_of=i)[1] for i in range(6)]
    for i in range(6):
        for j in range(i):
            assert correlation(found[i], found[j]) < 5.0 / math.sqrt(found[i].size)


def test_neighbouring_worlds_and_columns_are_independent():
    _, uniform, normal = draws()
    for values in (uniform, normal):
        assert correlation(values[1:], values[:-1]) < 5.0 / math.sqrt(values.size)
        matrix = np.corrcoef(values.T) - np.eye(COLUMNS)
        assert np.abs(matrix).max() < 5.0 / math.sqrt(WORLDS)


def test_streams_rarely_meet():
    """Of 4096 worlds at 64 clocks: n^2 / 2^33 = 8 pairs by chance."""
    states = np.concatenate([draws(step_count=step_count, columns=1)[0] for step_count in range(16, 80)])
    meetings = len(states) - len(np.unique(states))
    assert meetings < 8 + 5 * math.sqrt(8)


def test_uniform_numbers_fill_their_range():
    _, uniform, _ = draws()
    assert uniform.min() >= -2.0 and uniform.max() < 3.0
    for column in range(COLUMNS):
        assert kstest((uniform[:, column] + 2.0) / 5.0, "uniform").pvalue > 1e-3


def test_cut_normal_numbers_end_at_one_standard_deviation():
    _, _, normal = draws()
    cells = normal.size
    assert np.abs(normal).max() == 1.0
    assert normal.mean() == pytest.approx(0.0, abs=4.0 * SIGMA_OF_CUT / math.sqrt(cells))
    assert normal.std() == pytest.approx(SIGMA_OF_CUT, abs=4.0 * 0.4 / math.sqrt(cells))
    for end in (1.0, -1.0):  # beyond one sigma to either side
        assert np.mean(normal == end) == pytest.approx(0.15866, abs=4.0 * 0.366 / math.sqrt(cells))
    inside = normal[np.abs(normal) < 1.0]
    assert kstest(inside, truncated).pvalue > 1e-3


def truncated(x):
    """Distribution of a standard normal number that lies within one standard deviation."""
    cdf = np.vectorize(lambda value: 0.5 * (1.0 + math.erf(value / math.sqrt(2.0))))
    return (cdf(x) - cdf(-1.0)) / (cdf(1.0) - cdf(-1.0))


def test_a_draw_belongs_to_its_world():
    draw = make_stream(3, 12, 40, 1)
    assert draw.world == 12 and fold_in(draw, 5).world == 12

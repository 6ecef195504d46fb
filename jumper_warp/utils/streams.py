"""Random streams by purpose: a robot sampled for a report is never a robot sampled for tuning, whatever the seeds."""

from typing import Literal, get_args

from jumper_warp.utils.checks import MOST_SEED, check_seed

Purpose = Literal["training", "tuning", "selection", "reporting"]
PURPOSES: tuple[Purpose, ...] = get_args(Purpose)  # The kernels' streams take the index of a purpose


def purpose_seed(purpose: Purpose, seed: int) -> int:
    """Return the seed of a purpose's random numbers on the host: `seed` plus 2^31 times the index of the purpose.

    No two pairs of purpose and seed have the same, and training keeps `seed`. An `Env` takes purpose and seed
    separately: `jumper_warp.kernels.mdp.random` describes its streams. Raises InputError: seed not in 0 to 2^31 - 1.
    """
    check_seed(seed)
    return PURPOSES.index(purpose) * (MOST_SEED + 1) + int(seed)

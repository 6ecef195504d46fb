"""Random seeds by purpose: robots sampled for reporting differ from those sampled for tuning, whatever the seeds."""

from typing import Literal, get_args

from jumper_warp.utils.checks import MOST_SEED, check_seed

Purpose = Literal["training", "tuning", "selection", "reporting"]
PURPOSES: tuple[Purpose, ...] = get_args(Purpose)  # The kernels' streams take the index of a purpose


def purpose_seed(purpose: Purpose, seed: int) -> int:
    """Return the seed of a purpose's random numbers on the host: `seed` plus 2^31 times the index of the purpose.

    The result differs for every pair of purpose and seed; for training it is `seed`. `Env` takes purpose and seed
    separately, see `jumper_warp.kernels.mdp.random`. Raises InputError: seed not in 0 to 2^31 - 1.
    """
    check_seed(seed)
    return PURPOSES.index(purpose) * (MOST_SEED + 1) + int(seed)

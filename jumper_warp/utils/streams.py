"""Random seeds by purpose: random robots for reporting differ from those for tuning, whatever the seeds."""

from typing import Literal, get_args

from jumper_warp.utils.checks import MOST_SEED, check_seed

Purpose = Literal["training", "tuning", "selection", "reporting"]
PURPOSES: tuple[Purpose, ...] = get_args(Purpose)  # The kernels' streams take the index of a purpose


def purpose_seed(purpose: Purpose, seed: int) -> int:
    """Return a seed that differs for every pair of purpose and seed: `seed` plus 2^31 times the purpose's index.

    For training it is `seed`. It is for random numbers on the host; `Env` takes purpose and seed separately, see
    `jumper_warp.kernels.mdp.random`. Raises InputError: seed not in 0 to 2^31 - 1.
    """
    check_seed(seed)
    return PURPOSES.index(purpose) * (MOST_SEED + 1) + int(seed)

"""Warp module options and names of the kernels of a policy step."""

from typing import Any

FAST: dict[str, Any] = {"enable_backward": False, "fast_math": True}
"""Warp module options; fast_math: GPU divisions, roots, exponentials are exact to 2 units in the last place."""

_definitions: dict[str, list] = {}  # structs by their key, in the order of their definitions


def kernel_name(name: str, *structs: Any) -> str | None:
    """Return a kernel name that distinguishes structs of equal names, or None where Warp's default name suffices.

    If a struct is defined again, for example in a notebook's cell, its kernels need another name. Otherwise Warp
    returns the kernels with equal code, whose arguments have the earlier struct.
    """
    numbers = []
    for struct in structs:
        known = _definitions.setdefault(struct.key, [])
        if not any(struct is other for other in known):
            known.append(struct)
        numbers.append(next(i for i, other in enumerate(known) if struct is other))
    return "_".join([name, *map(str, numbers)]) if any(numbers) else None

"""`jumper deploy`: check a bundle, run the robot, or replay a log; the same program as `python deploy.pyz`."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper deploy` with the given arguments; modules: unused, as all commands take it.

    Raises InputError: the extra `deploy` is not installed. Exits as `jumper_warp.deploy.main.main`.
    """
    from jumper_warp.utils.errors import InputError

    try:
        from jumper_warp.deploy.main import main
    except ImportError as error:
        raise InputError(f'jumper deploy needs {error.name}: pip install "jumper-warp[deploy]"') from None
    main(args)

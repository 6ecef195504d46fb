"""`jumper list`: list the tasks, with their origin, and the project's policies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

from jumper_warp.cli.main import parse


@dataclass(frozen=True)
class ListCfg:
    """List the tasks, with their origin, and the project's policies."""


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Print the list; modules: the user's, whose tasks are registered already."""
    parse(ListCfg, "list", args)
    from jumper_warp.policies.folder import list_policies
    from jumper_warp.registry import TASKS, installed_tasks, load_installed, package_of

    packages, failures = {}, []
    for point in installed_tasks():
        try:
            load_installed(point)
            packages[point.name] = f", package {package_of(point)}"
        except Exception as error:  # one package must not hide what the others offer
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            failures.append(f"task    {point.name}  of package {package_of(point)} is left out: {reason:.300}")
    for name, entry in TASKS.items():
        aliases = f" ({', '.join(entry.aliases)})" if entry.aliases else ""
        print(f"task    {name}{aliases}  from {entry.origin}{packages.get(name, '')}")
    for line in failures:
        print(line)
    for name in list_policies():
        print(f"policy  {name}")

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
    """Print tasks and policies, one a line; modules: the user's, whose tasks are registered already."""
    parse(ListCfg, "list", args)
    from jumper_warp.policies.folder import list_policies
    from jumper_warp.registry import TASKS, installed_tasks, load_installed, package_of

    packages, failures = {}, []
    for entry_point in installed_tasks():
        name, package = entry_point.name, package_of(entry_point)
        try:
            load_installed(entry_point)
            packages[name] = f", package {package}"
        except Exception as error:  # an error in one package must not hide the tasks of others
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            failures.append(f"task    {name}  of package {package} is left out: {reason:.300}")
    for name, entry in TASKS.items():
        aliases = f" ({', '.join(entry.aliases)})" if entry.aliases else ""
        print(f"task    {name}{aliases}  from {entry.origin}{packages.get(name, '')}")
    for line in failures:
        print(line)
    for name in list_policies():
        print(f"policy  {name}")

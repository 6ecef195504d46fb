"""Generated tables in Markdown pages, between two comments that name them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.assets import POLICIES
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import write_atomically
from support.policy_choice import choice_table
from support.policy_comparisons import seed_section
from support.policy_results import RESULTS, saved_rows
from support.policy_tables import KEYS, TEST_TABLES, all_conditions, key_table, main_table, test_table

BLOCK = re.compile(r"(<!-- table: (?P<name>[\w. ]+) -->\n).*?(<!-- end of table -->)", re.DOTALL)


def pages() -> list[Path]:
    """Return the paths of the documentation pages and policies' READMEs that may have generated tables."""
    return [*sorted(RESULTS.glob("*.md")), RESULTS.parent / "reference/metrics.md",
            *sorted(POLICIES.glob("*/README.md"))]  # fmt: skip


def make_table(name: str, tasks: Mapping[str, TaskCfg]) -> str:
    """Return a table as Markdown; name: `main POLICY`, `all POLICY`, `test NAME`, `keys NAME`, `choice` or `seeds`.

    Raises InputError: there is no such table.
    """
    kind, _, subject = name.partition(" ")
    if kind in ("main", "all") and subject in tasks:
        return (main_table if kind == "main" else all_conditions)(subject, tasks[subject])
    if kind == "test" and subject in TEST_TABLES:
        return test_table(subject)
    if kind == "keys" and subject in KEYS:
        return key_table(subject)
    if name == "choice":
        return choice_table(tasks)
    if name == "seeds":
        return seed_section([row for policy in tasks for row in saved_rows(policy)])
    raise InputError(f"no table {name!r:.40}")


def filled(text: str, tasks: Mapping[str, TaskCfg]) -> str:
    """Return the text of a page with its tables made from the policies' metrics.json; tasks: of all policies."""
    return BLOCK.sub(lambda block: f"{block[1]}\n{make_table(block['name'], tasks)}\n{block[3]}", text)


def write_pages(tasks: Mapping[str, TaskCfg], paths: Iterable[Path]) -> list[Path]:
    """Make the tables of pages from the policies' metrics.json, and return the paths of the pages that changed."""
    changed = []
    for path in paths:
        old = path.read_text(encoding="utf-8")
        if (new := filled(old, tasks)) != old:
            write_atomically(path, new.encode())
            changed.append(path)
    return changed

"""All numbers of all tasks against `docs/results/departures.csv`, which gives the reason for each departure."""

import pytest

from departure_table import BASES, PAPERS, read, rows_of
from jumper_warp.registry import TASKS

ROWS = read()


def rows_in_file(task):
    """Return (ours, paper) by name of the file's rows of a task; of a paper other than the three tasks', empty."""
    rows = [row for row in ROWS if row["task"] == task]
    return {row["name"]: (row["ours"], row["paper"] if task in PAPERS else "") for row in rows}


def test_the_file_has_all_tasks():
    stock = {name for name, entry in TASKS.items() if entry.origin.startswith("jumper_warp.")}
    assert {*PAPERS, *PAPERS.values(), *BASES} == stock
    assert {row["task"] for row in ROWS} == {*PAPERS, *BASES}


@pytest.mark.parametrize("task", [*PAPERS, *BASES])
def test_tasks_and_the_papers_tasks_have_the_numbers_of_the_file(task):
    """If a number changed on purpose: `python docs/_ext/departure_table.py`, then write its reason into the file."""
    assert rows_of(task) == rows_in_file(task)


def test_departures_have_reasons_and_the_papers_values_have_sources():
    for row in ROWS:
        assert row["reason"] or row["ours"] == row["paper"], row
        assert row["source"] or row["paper"] in ("", "none"), row

"""All numbers of all tasks against `docs/results/departures.csv`, which gives the reason for each departure."""

import dataclasses

import pytest

from departure_table import BASES, PAPERS, read, rows_of
from jumper_warp.registry import TASKS, make_task

ROWS = read()


def rows_in_file(task):
    """Return (ours, paper) by name of the file's rows of a task; of a paper other than the three tasks', empty."""
    rows = [row for row in ROWS if row["task"] == task]
    return {row["name"]: (row["ours"], row["paper"] if task in PAPERS else "") for row in rows}


def test_the_file_has_all_tasks():
    assert {*PAPERS, *PAPERS.values(), *BASES} == set(TASKS)
    assert {row["task"] for row in ROWS} == {*PAPERS, *BASES}


@pytest.mark.parametrize("task", [*PAPERS, *BASES])
def test_tasks_and_the_papers_tasks_have_the_numbers_of_the_file(task):
    """If a number changed on purpose: `python docs/_ext/departure_table.py`, then write its reason into the file."""
    assert rows_of(task) == rows_in_file(task)


def test_departures_have_reasons_and_the_papers_values_have_sources():
    for row in ROWS:
        assert row["reason"] or row["ours"] == row["paper"], row
        assert row["source"] or row["paper"] in ("", "none"), row


def longer(task):
    """Return the task with episodes of 30 s instead of 20 s."""
    settings = dataclasses.replace(task.reset.settings, episode=30.0)
    return dataclasses.replace(task, reset=dataclasses.replace(task.reset, settings=settings))


MUTATIONS = [
    ("vertical-jump", lambda task: task.with_terms("rewards", air_posture={"weight": 8.0})),
    ("vertical-jump", lambda task: task.with_terms("terminations", hard_impact={"flight": 490.5})),
    ("horizontal-jump", lambda task: dataclasses.replace(task, action_scale=(15.0, 91.0))),
    ("horizontal-jump-sighted", lambda task: task.with_terms("rewards", tracking={"std_fine": 0.031})),
    ("velocity-flat", longer),
    ("velocity-trot", lambda task: dataclasses.replace(task, levels=(dataclasses.replace(task.levels[0], levels=9),))),
    ("attitude", lambda task: dataclasses.replace(task, levels=task.levels[:-1])),
]


@pytest.mark.parametrize(("name", "change"), MUTATIONS)
def test_a_changed_number_is_unlike_the_file(name, change):
    assert rows_of(name, change(make_task(name))) != rows_in_file(name)

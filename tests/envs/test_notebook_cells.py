"""Cells of a notebook that run again: a new environment uses the present helper functions and constants of a term."""

import dataclasses
import itertools
import linecache
import sys
from types import ModuleType

import pytest
import torch

from hold_height import hold_height
from jumper_warp.envs.env import Env
from jumper_warp.tasks.terms import EventTerm, ObservationTerm, RewardTerm

IMPORTS = "from typing import Any\nimport warp as wp\nfrom jumper_warp import mdp\n"
INNER = "@wp.func\ndef inner(x: float) -> float:\n    return {} * x\n"
HELPER = "@wp.func\ndef helper(x: float) -> float:\n    return inner(x) + {}\n"
PYTHON = "OFFSET = {}\n"
CONSTANT = "FACTOR = wp.constant({})\n"
NESTED = "class constants:\n    SHIFT = {}\n"
TERMS = """
@wp.func
def value() -> float:
    return FACTOR * helper(1.0) + OFFSET + constants.SHIFT

@wp.func
def prize(robot: mdp.RobotView, state: Any) -> float:
    return value()

@wp.func
def seen(robot: mdp.RobotView, state: Any) -> float:
    return value()

@wp.func
def push(robot: mdp.RobotParameters, rng: mdp.RngStream):
    robot.push[rng.world] = wp.spatial_vector(value(), 0.0, 0.0, 0.0, 0.0, 0.0)
"""
CELLS = {INNER: (2.0, 3.0), HELPER: (10.0, 20.0), PYTHON: (10.0, 30.0), CONSTANT: (1.0, 2.0), NESTED: (0.0, 0.5)}
"""Cells whose number changes: its first value and the one of the second run."""


class Notebook:
    """Namespace in which cells run, as in IPython."""

    numbers = itertools.count()

    def __init__(self) -> None:
        self.module = ModuleType(f"notebook_{next(self.numbers)}")
        sys.modules[self.module.__name__] = self.module

    def run(self, source: str) -> None:
        """Run a cell."""
        file = f"<cell {next(self.numbers)}>"
        linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
        exec(compile(source, file, "exec"), vars(self.module))

    def values(self) -> list[float]:
        """Return the values of reward, observation and event in the first step of a new environment."""
        task, own = hold_height(), self.module
        observations = dataclasses.replace(
            task.observations, actor=(*task.observations.actor, ObservationTerm(own.seen, clip=1.0e4))
        )
        task = dataclasses.replace(
            task, rewards=(RewardTerm(own.prize, 1.0, scale_by_dt=False),), observations=observations,
            events=(EventTerm(own.push, update_solver=False),),
        )  # fmt: skip
        env = Env(task, 2, device="cpu", noise=False)
        env.reset()
        env.step(torch.zeros(2, 12))
        push = env.parameters.push.numpy()[0, 0]
        return [env.reward_terms["prize"][0].item(), env.obs[0, -1].item(), float(push)]


@pytest.fixture(scope="module")
def notebook():
    """Return a notebook in which all cells have run, and whose terms have been used."""
    notebook = Notebook()
    for cell in (IMPORTS, *(cell.format(value) for cell, (value, _) in CELLS.items()), TERMS):
        notebook.run(cell)
    assert notebook.values() == [22.0] * 3
    return notebook


@pytest.mark.parametrize(
    ("cell", "value"),
    [(INNER, 23.0), (HELPER, 32.0), (PYTHON, 42.0), (CONSTANT, 34.0), (NESTED, 22.5)],
    ids=["called function", "calling function", "Python constant", "wp.constant", "attribute"],
)
def test_a_cell_that_runs_again_changes_the_terms_of_a_new_environment(notebook, cell, value):
    first, second = CELLS[cell]
    notebook.run(cell.format(second))
    assert notebook.values() == [value] * 3
    notebook.run(cell.format(first))
    assert notebook.values() == [22.0] * 3

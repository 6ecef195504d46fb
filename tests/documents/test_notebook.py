"""The notebook that opens on Colab runs, but for the cell that uploads and installs a wheel there."""

import json
import math

import matplotlib
import pytest

from snippet_commands import ROOT

NOTEBOOK = json.loads((ROOT / "docs/tutorials/try.ipynb").read_text(encoding="utf-8"))
CODE = ["".join(cell["source"]) for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]


def test_notebook_raises_the_robot_to_its_goal_and_has_a_gradient():
    matplotlib.use("Agg")
    names = {}
    for source in CODE[1:]:
        exec(source, names)
    assert max(names["heights"]) == pytest.approx(0.9, abs=0.1)
    assert 0.0 < names["changes"].grad.norm().item() < math.inf

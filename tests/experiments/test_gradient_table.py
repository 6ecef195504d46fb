import sys

import pytest

from experiments import gradient_table
from jumper_warp.utils.output import read_values

RIVALS = ("ours", "ours_single", "mujoco", "mjx")


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """Metrics of short pushes on the ground, without MJX, and what is printed on standard error."""
    folder = tmp_path_factory.mktemp("gradient_table")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "jax", None)
        lines = []
        patch.setattr(gradient_table, "announce", lines.append)
        args = gradient_table.Args(rivals=RIVALS, lengths=(16,), repeats=1, out=folder)
        return gradient_table.main(args), lines, folder


@pytest.mark.parametrize(("name", "bound"), [("ours", 1e-6), ("ours_single", 1e-3), ("mujoco", 1e-6)])
def test_gradient_agrees_with_differences_of_the_same_simulation(table, name, bound):
    values, _, _ = table
    assert values[f"{name}_uncertainty_16"] < 1e-6
    assert 0.0 < values[f"{name}_error_16"] < bound
    assert values[f"{name}_cost"] > 1.0


def test_missing_package_is_reported_in_one_line_and_the_metrics_are_written(table):
    values, lines, folder = table
    assert len(lines) == 1 and lines[0].startswith("mjx is skipped: ") and "jax" in lines[0]
    assert not any(key.startswith("mjx_") for key in values)
    assert values == read_values(folder)

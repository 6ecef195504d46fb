import ast
from pathlib import Path

import pytest

from jumper_warp.utils.errors import InputError, suggestion

ROOT = Path(__file__).resolve().parents[2]
FILES = [*ROOT.glob("jumper_warp/**/*.py"), *ROOT.glob("experiments/*.py")]


def test_input_error_is_a_value_error_with_one_line():
    assert str(InputError("expected  a,\n\tgot b ")) == "expected a, got b"
    assert issubclass(InputError, ValueError)


@pytest.mark.parametrize("name", ["vertical-jmup", "Vertical_Jump", "verticaljump"])
def test_misspelt_name_suggests_the_closest_known_one(name):
    assert suggestion(name, ["horizontal-jump", "vertical-jump", "attitude"]) == "; did you mean 'vertical-jump'?"


def test_nothing_is_suggested_for_a_name_like_no_other():
    assert suggestion("zebra", ["horizontal-jump", "vertical-jump"]) == ""


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_modules_raise_input_error_instead_of_value_error(path):
    """No module raises ValueError or derives a class from it; a command would print a traceback for these."""
    tree = ast.parse(path.read_text())
    raised = [node.exc for node in ast.walk(tree) if isinstance(node, ast.Raise) and node.exc is not None]
    bases = [base for node in ast.walk(tree) if isinstance(node, ast.ClassDef) for base in node.bases]
    classes = [exc.func if isinstance(exc, ast.Call) else exc for exc in raised]
    classes += bases if path.name != "errors.py" else []  # which defines InputError
    assert "ValueError" not in [node.id for node in classes if isinstance(node, ast.Name)]

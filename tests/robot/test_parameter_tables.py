"""Tables of parameters in the documentation match the code."""

import importlib.util
from pathlib import Path

import pytest

FILE = Path(__file__).parents[2] / "docs/parameter_tables.py"
SPEC = importlib.util.spec_from_file_location("parameter_tables", FILE)
tables = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(tables)


@pytest.mark.parametrize("page", tables.PAGES, ids=lambda page: page.name)
def test_tables_of_a_page_match_the_code(page):
    text = page.read_text()
    assert tables.updated(text) == text, f"run python {FILE.relative_to(FILE.parents[1])}"


def test_each_table_is_in_one_page():
    names = [name for page in tables.PAGES for _, name, _ in tables.BLOCK.findall(page.read_text())]
    assert sorted(names) == sorted(tables.TABLES)

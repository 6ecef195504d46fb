"""Every snippet of docs/tutorials runs or parses."""

import pytest

from snippet_commands import ROOT
from snippets import Page


@pytest.mark.parametrize("page", sorted(path.name for path in (ROOT / "docs" / "tutorials").glob("*.md")))
def test_snippets_of_a_tutorial_run_or_parse(page, tmp_path, one_thread):
    Page(ROOT / "docs" / "tutorials" / page).run(tmp_path)

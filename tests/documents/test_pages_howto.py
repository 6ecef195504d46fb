"""Every snippet of docs/howto runs or parses."""

import pytest
from snippet_commands import ROOT
from snippets import Page


@pytest.mark.parametrize("page", sorted(path.name for path in (ROOT / "docs" / "howto").glob("*.md")))
def test_page(page, tmp_path, one_thread):
    Page(ROOT / "docs" / "howto" / page).run(tmp_path)

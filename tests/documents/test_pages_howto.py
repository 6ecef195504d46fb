"""Every snippet of docs/howto runs or parses."""

import pytest

from snippet_commands import ROOT
from snippets import Page


@pytest.mark.parametrize("page", sorted(path.name for path in (ROOT / "docs" / "howto").glob("*.md")))
def test_snippets_of_a_how_to_page_run_or_parse(page, tmp_path, one_thread):
    Page(ROOT / "docs" / "howto" / page).run(tmp_path)

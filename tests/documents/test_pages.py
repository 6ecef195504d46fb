"""Every snippet of the README, the site and the policies' pages runs or parses."""

import pytest
from snippet_commands import ROOT
from snippets import Page

PATTERNS = ("README.md", "CONTRIBUTING.md", "docs/**/*.md", "assets/policies/*/README.md", "experiments/README.md")
APART = ("docs/tutorials", "docs/howto")  # in files of their own, for workers that take a file each
PAGES = [str(path.relative_to(ROOT)) for pattern in PATTERNS for path in sorted(ROOT.glob(pattern))]


@pytest.mark.parametrize("page", [page for page in PAGES if not page.startswith(APART)])
def test_page(page, tmp_path, one_thread):
    Page(ROOT / page).run(tmp_path)

"""Every snippet of the README, the site and the policies' pages runs or parses."""

import re
import shlex

import pytest
from markdown_it import MarkdownIt

from snippet_commands import ROOT, Commands
from snippets import Page

PATTERNS = ("README.md", "CONTRIBUTING.md", "docs/**/*.md", "assets/policies/*/README.md", "experiments/README.md")
APART = ("docs/tutorials", "docs/howto")  # in files of their own, for workers that take a file each
BUILT = ("docs/_", "docs/reference/api/", "docs/reference/mdp/", "docs/results/policies/")  # written by `make docs`
PAGES = [
    page
    for pattern in PATTERNS
    for page in sorted(str(path.relative_to(ROOT)) for path in ROOT.glob(pattern))
    if not page.startswith(BUILT)
]


@pytest.mark.parametrize("page", [page for page in PAGES if not page.startswith(APART)])
def test_snippets_of_a_page_run_or_parse(page, tmp_path, one_thread):
    Page(ROOT / page).run(tmp_path)


def test_commands_below_the_pictures_of_the_readme_parse(monkeypatch):
    monkeypatch.chdir(ROOT)
    tokens = MarkdownIt("commonmark").enable("table").parse((ROOT / "README.md").read_text())
    codes = [child.content for token in tokens for child in token.children or () if child.type == "code_inline"]
    commands = [shlex.split(code) for code in codes if code.startswith("jumper ")]
    assert 6 <= len(commands) <= 9
    for words in commands:
        Commands().check(words)


def test_list_of_pages_is_complete():
    listed = set(re.findall(r"\((\S+)\.html\)", (ROOT / "docs/llms.txt").read_text()))
    pages = {page.removeprefix("docs/").removesuffix(".md") for page in PAGES if page.count("/") == 2}
    contents = {f"{folder}/index" for folder in ("tutorials", "howto", "explanation", "reference")}
    assert listed == pages - contents

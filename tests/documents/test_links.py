"""Relative links and pictures of the pages outside docs/, whose links the build of the site checks, and plain HTML."""

from html.parser import HTMLParser
from urllib.parse import unquote, urlparse

import pytest
from markdown_it import MarkdownIt

from snippet_commands import ROOT

PATTERNS = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "experiments/README.md", "assets/policies/*/README.md")
PAGES = [str(path.relative_to(ROOT)) for pattern in PATTERNS for path in sorted(ROOT.glob(pattern))]


class HtmlLinks(HTMLParser):
    """Collects the `src` and `href` of HTML in a page."""

    def __init__(self):
        super().__init__()
        self.links = []

    def handle_starttag(self, tag, attrs):
        """Store the links of a start tag; attrs: pairs of name and value."""
        self.links += [value for name, value in attrs if name in ("src", "href")]


def links_of(text):
    """Return the targets of all links and pictures of a page, in Markdown and in HTML."""
    html, links, tokens = HtmlLinks(), [], MarkdownIt("commonmark").enable("table").parse(text)
    for token in [*tokens, *(child for parent in tokens for child in parent.children or ())]:
        if token.type.startswith("html"):
            html.feed(token.content)
        links += [token.attrs[name] for name in ("href", "src") if name in token.attrs]
    return links + html.links


def missing_links(page):
    """Return the relative links of a page whose file does not exist."""
    paths = [unquote(urlparse(link).path) for link in links_of(page.read_text()) if not urlparse(link).scheme]
    return [path for path in paths if path and not (page.parent / path).exists()]


@pytest.mark.parametrize("page", PAGES)
def test_relative_links_exist(page):
    assert missing_links(ROOT / page) == []

"""Conversion of links to files outside docs/ in the documentation's pages, and in Markdown files that they include."""

from __future__ import annotations

import os
import posixpath
import re
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

LINK = re.compile(r"(\]\()(?!\w+:|#|/)([^)\s]+)")
FENCE = re.compile(r"(^(`{3,}|~{3,}).*?^\2|`[^`\n]+`)", re.M | re.S)


def relocated(text: str, source: str, target: str) -> str:
    """Return Markdown whose relative links, made for a file in folder `source`, work in folder `target`.

    Links in code stay. source, target: relative to one folder, with /.
    """

    def moved(match: re.Match[str]) -> str:
        return match[1] + posixpath.relpath(posixpath.join(source, match[2]), target or ".")

    parts = re.split(FENCE, text)
    return "".join(LINK.sub(moved, part) if i % 3 == 0 else part for i, part in enumerate(parts) if i % 3 < 2)


def relocate_included(app: Sphinx, path: Path, parent: str, content: list[str]) -> None:
    """Change the links of an included file in place so that they work in the page that includes it."""
    target = posixpath.dirname(app.env.docname)
    content[0] = relocated(content[0], path.parent.as_posix(), target)


class RepositoryLinks(SphinxTransform):
    """Replace links to files outside docs/ by links to their pages, links to the repository, or their paths."""

    default_priority = 400  # before Sphinx collects downloads and resolves references

    def apply(self, **_: Any) -> None:
        """Replace the links of one page."""
        docs = Path(self.env.srcdir)
        for kind in (addnodes.download_reference, addnodes.pending_xref):
            for link in [*self.document.findall(kind)]:
                path, fragment = self.target(link)
                if path and path.exists() and path.is_relative_to(docs.parent) and not path.is_relative_to(docs):
                    link.replace_self(self.replacement(link, path.relative_to(docs.parent).as_posix(), fragment))

    def target(self, link: Any) -> tuple[Path | None, str | None]:
        """Return path and fragment of a link in Markdown; None for a link that is no path, or leads to a page."""
        if link.get("reftype") != "myst":
            return None, None
        if link.get("refdomain") == "doc":  # MyST takes any Markdown file for a page: an absolute path without suffix
            path = Path(f"{link['reftarget']}.md")
            return (path if path.is_absolute() else None), link.get("reftargetid")
        target, _, fragment = str(link["reftarget"]).partition("#")
        return Path(os.path.normpath(Path(self.env.doc2path(self.env.docname)).parent / target)), fragment or None

    def replacement(self, link: Any, path: str, fragment: str | None) -> nodes.Node:
        """Return the node that replaces a link to a file or folder of the repository."""
        if page := self.config.repository_pages.get(path):
            attributes = {"refdomain": "doc", "reftarget": page, "reftargetid": fragment}
            return addnodes.pending_xref("", *link.children, refdoc=self.env.docname, reftype="myst",
                                         refexplicit=True, **attributes)  # fmt: skip
        if self.config.repository:
            return nodes.reference("", "", *link.children, refuri=f"{self.config.repository}/{path}")
        text = link.astext()
        if text.rstrip("/") in (path, posixpath.basename(path)) or path.endswith(text):
            return nodes.literal(path, path)
        return nodes.inline("", "", *link.children, nodes.Text(" ("), nodes.literal(path, path), nodes.Text(")"))


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the conversion of links, and its settings, with Sphinx."""
    app.add_config_value("repository", "", "env", str)
    app.add_config_value("repository_pages", {}, "env", dict)
    app.connect("include-read", relocate_included)
    app.add_transform(RepositoryLinks)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

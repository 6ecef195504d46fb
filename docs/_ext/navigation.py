"""Navigation tree from page titles alone: Sphinx copies every heading and API object for each page."""

from __future__ import annotations

from functools import cache
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment


@cache
def titles(env: BuildEnvironment) -> dict[str, nodes.bullet_list]:
    """Return the contents of all pages by name; below a page's title stand only its lists of pages."""
    found = {}
    for page, contents in env.tocs.items():
        found[page] = contents
        children = contents[0].children if len(contents) == 1 else []
        if len(children) > 1:  # as Sphinx's option titles_only
            lists = [each.deepcopy() for each in contents[0].findall(addnodes.toctree)]
            below = [nodes.bullet_list("", *lists)] if lists else []
            found[page] = nodes.bullet_list("", nodes.list_item("", children[0].deepcopy(), *below))
    return found


def use_titles(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: Any) -> None:
    """Make the navigation tree of one page without headings."""
    full = context["toctree"]

    def toctree(**options: Any) -> str:
        tocs = app.env.tocs
        app.env.tocs = titles(app.env) if options.get("titles_only") else tocs
        try:
            return full(**options)
        finally:
            app.env.tocs = tocs

    context["toctree"] = toctree


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the navigation tree before the theme asks for it."""
    app.connect("html-page-context", use_titles, priority=400)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

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
    """Return the navigation list of every page by its name: the page's title and its subpages, without headings."""
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
    """Replace the navigation tree of a page's template by one that omits headings if the theme requests titles only."""
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
    """Register the navigation tree with Sphinx, before the theme uses it."""
    app.connect("html-page-context", use_titles, priority=400)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

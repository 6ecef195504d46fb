"""Settings of the documentation site; `make docs` builds it.

Links. A page links to any file of the repository by its relative path, as on a repository host. The site resolves it:

- a page of docs/, or a file that is a page of the site (`repository_pages`: CONTRIBUTING.md, the policies' READMEs): a
  link to the page;
- another file of docs/: a download;
- another file or folder: a link to `repository`, or its path as code while `repository` is empty.

A target that does not exist is a warning, and `make docs` stops at warnings. In an included file links are relative to
that file.

Generated. docs/_generated holds texts that pages include; docs/reference/api, docs/reference/mdp and
docs/results/policies hold generated pages. The four folders are rewritten by each build and are not in git.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
ROOT = DOCS.parent
sys.path[:0] = [str(DOCS / "_ext"), str(ROOT)]

from jumper_warp.utils.version import __version__  # noqa: E402

project = "jumper-warp"
author = "The jumper-warp authors"
copyright = author
release = version = __version__

repository = ""
"""Address of the repository's files, without / at the end, such as https://host/owner/jumper-warp/blob/main."""
POLICY_PAGES = {file.parent.name: file for file in sorted(ROOT.glob("assets/policies/*/README.md"))}
repository_pages = {
    "README.md": "index",
    "CONTRIBUTING.md": "contributing",
    **{file.relative_to(ROOT).as_posix(): f"results/policies/{name}" for name, file in POLICY_PAGES.items()},
}

extensions = [
    "myst_parser", "sphinx.ext.autodoc", "sphinx_copybutton", "sphinx_design", "api_pages", "mathml", "navigation",
    "repository", "units",
]  # fmt: skip
exclude_patterns = ["_build", "_generated", "_ext"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
myst_enable_extensions = ["attrs_inline", "colon_fence", "deflist", "dollarmath", "html_image"]
myst_heading_anchors = 3
myst_links_external_new_tab = True
suppress_warnings = ["ref.python"]  # a type in a signature with the name of several classes

autodoc_default_options = {"members": True, "undoc-members": True, "member-order": "bysource"}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
autodoc_preserve_defaults = True
add_module_names = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 72
toc_object_entries_show_parents = "hide"

smartquotes = False  # -- is part of flags
html_math_renderer = "mathml"
html_theme = "furo"
html_title = "jumper-warp"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_extra_path = ["llms.txt"]
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
copybutton_prompt_text = "$ "


def write_pages() -> None:
    """Write the generated references and pages."""
    from api_pages import api_pages, api_table
    from cli_page import cli_page
    from mdp_page import mdp_pages

    texts = {"_generated/cli.md": cli_page(), "_generated/api.md": api_table()}
    for name, text in mdp_pages().items():
        texts[f"_generated/{name}" if name == "mdp.md" else f"reference/mdp/{name}"] = text
    texts |= {f"reference/api/{name}": text for name, text in api_pages().items()}
    for name, file in POLICY_PAGES.items():
        source = Path("../../..") / file.relative_to(ROOT)
        texts[f"results/policies/{name}.md"] = f"```{{include}} {source.as_posix()}\n```\n"
    for name, text in texts.items():
        path = DOCS / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text() != text:  # an unchanged page is not read again
            path.write_text(text)


def setup(app: Any) -> None:
    """Write the generated pages before Sphinx looks for pages."""
    write_pages()

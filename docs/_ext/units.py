"""Sphinx transform that prevents line breaks between a number and its unit, outside of code."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

UNITS = ("%", "cm", "deg", "GB", "h", "Hz", "J", "kg", "m", "min", "mm", "ms", "N", "rad", "s")
SPACE = re.compile(rf"(?<=\d) (?=(?:{'|'.join(UNITS)})(?!\w))")
CODE = (nodes.FixedTextElement, nodes.literal, nodes.math)


def joined(text: str) -> str:
    """Return text with no-break spaces before units: "0.5 m/s"."""
    return SPACE.sub("\N{NO-BREAK SPACE}", text)


class Units(SphinxTransform):
    """Transform of a page that puts no-break spaces before units."""

    default_priority = 999  # after links and signatures

    def apply(self, **_: Any) -> None:
        """Replace spaces before units in the texts of one page."""
        for text in [*self.document.findall(nodes.Text)]:
            if SPACE.search(text) and not isinstance(text.parent, CODE):
                text.parent.replace(text, nodes.Text(joined(str(text))))


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the transform `Units` with Sphinx."""
    app.add_transform(Units)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

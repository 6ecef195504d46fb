"""Markdown table of the values that a robot overlay (a robot's JSON file) may have, from ranges and comments in code.

    python docs/_ext/overlay_table.py

writes it into docs/reference/overlays.md between the two marker comments.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from jumper_warp.cli.flags import field_docs
from jumper_warp.robot.overlay import RANGES, RATIO
from jumper_warp.robot.values import LATERAL, LINK_KINDS, TRANSVERSAL, RobotValues

PAGE = Path(__file__).parents[1] / "reference" / "overlays.md"
BEGIN, END = "<!-- table: overlay -->\n", "<!-- end of table -->\n"
HEAD = "| name | values | unit | described | range | content |\n|---|---|---|---|---|---|\n"
COMMENT = re.compile(r"\(N, \d+\) \[(?P<unit>[^\]]*)\],? ?(?P<content>.*)", re.DOTALL)


def described(values: np.ndarray) -> str:
    """Format a quantity of the robot description as text, equal values once; values: (columns,)."""
    texts = [f"{value:.5g}" for value in values]
    if len(set(texts)) == 1:
        return texts[0]
    if len(texts) == len(LATERAL + TRANSVERSAL):
        return f"lateral {texts[LATERAL[0]]}, others {texts[TRANSVERSAL[0]]}"
    return ", ".join(texts)


def overlay_table() -> str:
    """Return the Markdown table of all values that a robot overlay may have."""
    docs, nominal, rows = field_docs(RobotValues), vars(RobotValues.nominal(1)), []
    kinds = ", ".join(LINK_KINDS).replace("_", " ")
    for name, allowed in RANGES.items():
        comment = COMMENT.fullmatch(" ".join(docs[name].split()))
        assert comment is not None, f"the comment of RobotValues.{name} has no shape and unit"
        values, unit = nominal[name][0], "ratio" if allowed is RATIO else comment["unit"]
        limits = f"{allowed.low:g} to {allowed.high:g}"
        content = comment["content"].replace("entry of `LINK_KINDS`", f"kind of link: {kinds}").rstrip(".")
        rows.append(f"| `{name}` | {len(values)} | {unit} | {described(values)} | {limits} | {content} |\n")
    return HEAD + "".join(rows)


def with_table(page: str) -> str:
    """Return the text of a page with the table of overlay values between its two marker comments."""
    before, rest = page.split(BEGIN)
    return f"{before}{BEGIN}\n{overlay_table()}\n{END}{rest.split(END)[1]}"


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8")), encoding="utf-8")

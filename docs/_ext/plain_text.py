"""Conversion of plain-text docstrings, with code in backticks, to Markdown and reStructuredText."""

from __future__ import annotations

import re

CODE = re.compile(r"(`[^`]*`)")


def paragraphs(doc: str) -> list[str]:
    """Return the paragraphs of a docstring; an indented one is a block of code."""
    return re.split(r"\n\s*\n", doc.strip("\n"))


def escaped(text: str, special: str) -> str:
    """Return text with a backslash before special characters, except in code between backticks."""
    parts = CODE.split(text)
    return "".join(part if i % 2 else re.sub(f"([\\\\{re.escape(special)}])", r"\\\1", part) for i, part in enumerate(parts))


def to_markdown(doc: str) -> str:
    """Return a docstring as Markdown (MyST)."""
    parts = paragraphs(doc)
    return "\n\n".join(part if part.startswith("    ") else escaped(part, "*_$<>[]|#{}") for part in parts)


def to_rst(doc: str) -> str:
    """Return a docstring as reStructuredText."""
    return "\n\n".join(
        f"::\n\n{part}" if part.startswith("    ") else _inline_rst(" ".join(part.split())) for part in paragraphs(doc)
    )


def _inline_rst(text: str) -> str:
    """Return one paragraph as reStructuredText; inline code is separated from adjacent letters."""
    parts = CODE.split(text)
    for i in range(0, len(parts), 2):
        before, after = parts[i - 1 : i], parts[i + 1 : i + 2]
        inner = escaped(parts[i], "*_|`")
        start = "\\ " if before and inner[:1] not in ("", " ") else ""
        end = "\\ " if after and inner[-1:] not in ("", " ", "(", "[") else ""
        parts[i] = f"{start}{inner}{end}"
    return "".join(f"`{part}`" if i % 2 else part for i, part in enumerate(parts))

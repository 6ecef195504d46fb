"""Make the pictures of the policies' pages from their commands in `policy_pages.toml`.

python -m docs.policy_pictures vertical_jump/picture
"""

from __future__ import annotations

import io
import shlex
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from experiments.support.policy_results import PAGES
from jumper_warp.cli.main import main as jumper
from jumper_warp.policies.catalog import add_files
from jumper_warp.utils.assets import POLICIES
from jumper_warp.utils.errors import InputError

PICTURES: dict[str, dict[str, str]] = PAGES["pictures"]  # Command and the name of its file, by policy/name


def webp(path: Path) -> bytes:
    """Return a picture as the content of a WebP file."""
    image = io.BytesIO()
    Image.open(path).convert("RGB").save(image, "webp", quality=88, method=6)
    return image.getvalue()


def main(names: Sequence[str]) -> list[Path]:
    """Run the commands, add the pictures to the policies' folders, and return their paths.

    Raises InputError: an unknown name.
    """
    if unknown := [name for name in names if name not in PICTURES]:
        raise InputError(f"no picture {unknown[0]!r:.40}; there are {', '.join(PICTURES)}")
    written = []
    for name in names:
        policy, _, file = name.partition("/")
        with tempfile.TemporaryDirectory() as folder:
            jumper([*shlex.split(PICTURES[name]["command"]), "--out", folder])
            add_files(POLICIES / policy, {f"{file}.webp": webp(Path(folder) / PICTURES[name]["file"])})
        written.append(POLICIES / policy / f"{file}.webp")
    return written


if __name__ == "__main__":
    main(sys.argv[1:] or tuple(PICTURES))

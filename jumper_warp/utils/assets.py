"""Folder of the assets: the robot's description and the policies."""

from pathlib import Path


def assets_folder(package: Path) -> Path:
    """Return the assets folder of a package: inside it (wheel) if it exists there, else next to it (clone)."""
    inside = package / "assets"
    return inside if inside.is_dir() else package.parent / "assets"


ASSETS = assets_folder(Path(__file__).resolve().parents[1])  # The project's assets folder

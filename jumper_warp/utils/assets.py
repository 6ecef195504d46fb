"""Where the robot's description, the policies and the motions lie."""

from pathlib import Path


def assets_folder(package: Path) -> Path:
    """Return the folder of the assets: within the package if it came as a wheel, else beside it, as in a clone."""
    inside = package / "assets"
    return inside if inside.is_dir() else package.parent / "assets"


ASSETS = assets_folder(Path(__file__).resolve().parents[1])
"""The project's own."""

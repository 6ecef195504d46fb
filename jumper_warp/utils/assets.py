"""Folder of the assets: the robot's description and the policies."""

from pathlib import Path

from jumper_warp.utils.files import read_json


def assets_folder(package: Path) -> Path:
    """Return the folder of robot description and policies: inside the package (wheel), else next to it (clone)."""
    inside = package / "assets"
    return inside if inside.is_dir() else package.parent / "assets"


ASSETS = assets_folder(Path(__file__).resolve().parents[1])  # The project's assets folder
POLICIES = ASSETS / "policies"  # Folder of the project's own policies


def dashed(name: str) -> str:
    """Return the name of a task or policy with - for every _, so that both spellings compare equal."""
    return name.replace("_", "-")


def policy_tasks() -> dict[str, str]:
    """Return the task name of each of the project's policies, by policy name."""
    files = sorted(POLICIES.glob("*/config.json"))
    return {file.parent.name: read_json(file, "configuration")["interface"]["task"] for file in files}

"""Names of the three skills between which the robots of one environment can switch, and of their policies."""

from __future__ import annotations

from dataclasses import dataclass

WALK, JUMP_UP, JUMP_TO = range(3)  # Indices of the skills: walking, jump to a height, jump to a position


@dataclass(frozen=True)
class SkillNames:
    """Names or folders of three policies: for walking, for vertical jumps and for horizontal jumps."""

    walk: str = "walking"  # Policy that follows commanded velocities
    jump_up: str = "vertical_jump"  # Policy that jumps to a commanded height
    jump_to: str = "horizontal_jump"  # Policy that jumps to a commanded position

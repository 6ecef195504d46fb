"""Velocity tracking on uneven ground, slopes and steps, without seeing them; the critic sees the ground around.

It is the task on a plane but for the map, on which every world climbs to harder tiles as it follows its commands and
goes back where it falls, slower commands, higher swings, and less that a tilt or a rise costs.
"""

from __future__ import annotations

from dataclasses import replace

from jumper_warp.robot.terrain import TerrainCfg
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.terms import ObservationTerm
from jumper_warp.tasks.velocity.cfg import CommandCfg
from jumper_warp.tasks.velocity.flat import velocity_flat
from kernels.velocity import observations as velocity

COMMANDS = CommandCfg(narrow=(0.8, 0.6, 0.4, 0.8), wide=(0.8, 0.6, 0.4, 0.8), levels=0)
"""What is commanded on the map."""


def velocity_rough() -> TaskCfg:
    """Return the task on a map of uneven ground, slopes and steps."""
    flat = velocity_flat()
    task = replace(
        flat,
        name="velocity-rough",
        reset=replace(flat.reset, settings=replace(flat.reset.settings, terrain=TerrainCfg(), tolerance=0.25)),
        levels=(COMMANDS,),
        critic=(*flat.critic, ObservationTerm(velocity.ground_heights)),
    )
    return task.with_terms(
        "rewards", flat={"weight": -5.0}, vertical_velocity={"weight": -0.3}, foot_clearance={"height": 0.10}
    )

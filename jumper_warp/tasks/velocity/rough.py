"""Velocity tracking on uneven ground, slopes and steps; only the critic observes the ground.

It differs from the task on a plane by a terrain map, slower commands, higher swings and smaller penalties of tilt and
vertical speed. A world moves to harder tiles of the map while it tracks its commands, and to easier ones when it falls.
Robots fail mostly at steps up, where the shank of a planted paw hits the edge as the base moves on. Therefore the lean
of a shank over a planted paw is penalised, a collision costs a second's reward and ends the episode, and grounds with
steps up have two columns each.
"""

from __future__ import annotations

from dataclasses import replace

from jumper_warp.kernels.mdp import rewards as mdp_rewards
from jumper_warp.kernels.velocity import observations as velocity
from jumper_warp.kernels.velocity import rewards
from jumper_warp.robot.terrain import KINDS, TerrainCfg
from jumper_warp.tasks.cfg import ObservationsCfg, TaskCfg
from jumper_warp.tasks.terms import ObservationTerm, RewardTerm
from jumper_warp.tasks.units import DEG
from jumper_warp.tasks.velocity.cfg import CommandCfg
from jumper_warp.tasks.velocity.flat import WITHOUT_HISTORY, velocity_flat

COMMANDS = CommandCfg(first_range=(0.8, 0.6, 0.4, 0.8), last_range=(0.8, 0.6, 0.4, 0.8), levels=0)
"""Ranges of velocity commands on the terrain map, one level."""
GROUNDS = (*KINDS, "pit", "blocks")  # Kinds of the map's columns; "pit" and "blocks" twice
STEPS_UP = (
    RewardTerm(rewards.shank_lean, -5.0, threshold=35.0 * DEG, hip=0.045, thigh=0.175, shank=0.3),
    RewardTerm(mdp_rewards.collision, -4.0, scale_by_dt=False),
)
"""Penalties against shanks hitting edges of steps. They need `reward_floor=None`, or a collision would cost nothing."""


def velocity_rough() -> TaskCfg:
    """Return the task of velocity tracking on a terrain map of slopes, steps and uneven ground (`GROUNDS`)."""
    flat = velocity_flat()
    task = replace(
        flat,
        name="velocity-rough",
        reset=replace(
            flat.reset, settings=replace(flat.reset.settings, terrain=TerrainCfg(kinds=GROUNDS), tolerance=0.25)
        ),
        levels=(COMMANDS,),
        observations=ObservationsCfg(
            actor=WITHOUT_HISTORY, critic=(*flat.observations.critic, ObservationTerm(velocity.ground_heights))
        ),
    )
    task = task.with_terms(
        "rewards",
        flat_orientation_l2={"weight": -5.0},
        lin_vel_z_l2={"weight": -0.3},
        linear_velocity_fine={"weight": 1.5},
        yaw_rate_fine={"weight": 2.5},
        air_time={"weight": 5.0},
        rapid_stepping={"weight": -0.1},
        foot_clearance={"weight": -30.0, "target_height": 0.10},
    )
    return replace(task, rewards=(*task.rewards, *STEPS_UP), reward_floor=None)

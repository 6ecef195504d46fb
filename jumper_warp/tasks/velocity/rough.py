"""Velocity tracking on level ground, uneven ground, slopes and steps; only the critic observes the ground.

It differs from the task on a plane by a terrain map, slower commands, higher swings and smaller penalties of tilt and
vertical speed. A world moves to harder tiles of the map while it tracks its commands, and to easier ones when it falls.
Robots fail mostly at steps up, where the shank of a planted paw hits the edge as the base moves on. Therefore the lean
of a shank over a planted paw is penalised, a collision costs a second's reward and ends the episode, and grounds with
steps up have several columns.
"""

from __future__ import annotations

from dataclasses import replace

from jumper_warp.kernels.mdp import rewards as mdp_rewards
from jumper_warp.kernels.velocity import observations as velocity
from jumper_warp.kernels.velocity import rewards
from jumper_warp.robot.gravity import MARS
from jumper_warp.robot.terrain import KINDS, TerrainCfg
from jumper_warp.tasks.cfg import ObservationsCfg, TaskCfg
from jumper_warp.tasks.observations import remembered
from jumper_warp.tasks.terms import ObservationTerm, RewardTerm
from jumper_warp.tasks.units import DEG
from jumper_warp.tasks.velocity.cfg import CommandCfg, VelocityEvaluation
from jumper_warp.tasks.velocity.flat import WITHOUT_HISTORY, velocity_flat

ACTOR = remembered(WITHOUT_HISTORY, 8)  # Policy observation: over eight policy steps, or 0.13 s
REACH = (1.1, 1.1, 0.75, 1.1)
COMMANDS = CommandCfg(REACH, REACH, levels=0, standing_probability=0.15, resampling_time_range=(1.5, 5.0))
"""Velocity commands on the terrain map, at one level."""
GROUNDS = (*("flat",) * 3, *KINDS, *("pit",) * 2, *("blocks",) * 3)
"""Kinds of the map's columns. Half of them are level or have blocks, which are hardest."""
STEPS_UP = (
    RewardTerm(rewards.shank_lean, -10.0, threshold=35.0 * DEG, hip=0.045, thigh=0.175, shank=0.3),
    RewardTerm(mdp_rewards.collision, -4.0, scale_by_dt=False),
)
"""Penalties against shanks hitting edges of steps. They need `reward_floor=None`, or a collision would cost nothing."""


def velocity_rough() -> TaskCfg:
    """Return the task of velocity tracking on a terrain map of level ground, slopes and steps (`GROUNDS`)."""
    flat = velocity_flat()
    terrain = TerrainCfg(kinds=GROUNDS, step=(0.02, 0.08), slope=12.0)
    settings = replace(flat.reset.settings, terrain=terrain, tolerance=0.25)
    task = replace(
        flat,
        name="velocity-rough",
        reset=replace(flat.reset, settings=settings),
        levels=(COMMANDS,),
        observations=ObservationsCfg(
            actor=ACTOR, critic=(*flat.observations.critic, ObservationTerm(velocity.ground_heights))
        ),
    )
    task = task.with_terms(
        "rewards",
        linear_velocity_fine={"weight": 3.0},
        yaw_rate_fine={"weight": 6.0},
        lin_vel_z_l2={"weight": -0.5},
        flat_orientation_l2={"weight": -10.0},
        air_time={"weight": 5.0},
        rapid_stepping={"weight": -0.1},
        foot_clearance={"weight": -30.0, "target_height": 0.12},
    )
    direct = RewardTerm(rewards.lin_vel_xy_l1, -1.0)
    return replace(task, rewards=(*task.rewards, direct, *STEPS_UP), reward_floor=None)


def velocity_mars() -> TaskCfg:
    """Return the task of velocity tracking on the terrain map under the gravity of Mars, with slower commands."""
    reach = (0.8, 0.8, 0.6, 1.0)
    commands = replace(COMMANDS, first_range=reach, last_range=reach)
    evaluation = VelocityEvaluation((0.6, 0.5, 0.8))
    return replace(velocity_rough(), name="velocity-mars", gravity=MARS, levels=(commands,), evaluation=evaluation)

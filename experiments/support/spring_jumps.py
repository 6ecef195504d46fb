"""Open-loop jumps of robots with springs between the knees of each leg."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.robot.motors import MotorCfg, loose_filter, vertical_jump_filter
from jumper_warp.robot.overlay import RobotOverlay, with_springs
from jumper_warp.robot.values import RobotValues
from jumper_warp.sim.simulation import Simulation
from support.open_loop import EXTEND, HOLD, RAMP, STAND, simulate_jump, trace_metrics, transversal_command

FALLING = 60  # Number of policy steps after the extension in which a jump may still rise
FILTERS = {"stock": vertical_jump_filter, "loose": loose_filter}  # Functions that return the command filter, by name


@dataclass(frozen=True)
class SpringJumps:
    """Open-loop jumps with given motors, command filter, gravity and spring length."""

    motors: MotorCfg  # Gains and limits of the motors
    filter: str  # One of FILTERS
    gravity: float  # [m/s^2] Downward
    length: float  # [m] Rest length of the springs
    device: str | None  # Warp device, None: the default

    def simulation(self, count: int, robot: RobotOverlay | RobotValues, **settings: Any) -> Simulation:
        """Return a simulation of `count` robots; robot: their parameters; settings: more arguments of `Simulation`."""
        return Simulation(count, motors=self.motors, command_filter=FILTERS[self.filter](), gravity=self.gravity,
                          robot=robot, device=self.device, **settings)  # fmt: skip

    def apexes(self, stiffness: Sequence[float], squats: Sequence[float]) -> np.ndarray:
        """Simulate the jumps: return the largest base height [m] of each, (len(stiffness), len(squats)).

        stiffness [N/m]: of the springs; squats [deg]: commanded transversal angles of the squat.
        """
        shape = (len(stiffness), len(squats))
        robots = RobotValues.nominal(shape[0] * shape[1])
        robots.spring_stiffness[:, 0] = np.repeat(stiffness, shape[1])
        robots.spring_length[:, 0] = self.length
        sim = self.simulation(shape[0] * shape[1], robots, visuals=False)
        apex, extend_step = np.zeros(sim.num_worlds), STAND + RAMP + HOLD
        for tick in range(extend_step + EXTEND + FALLING):
            commands = [transversal_command(min(tick, extend_step + EXTEND - 1), squat) for squat in squats]
            sim.target.assign(np.outer(np.tile([0.0, 1.0, 1.0], 4), np.tile(commands, shape[0])).astype(np.float32))
            sim.step()
            if tick >= extend_step:
                apex = np.maximum(apex, sim.joint_q()[:, 2])
        return apex.reshape(shape)

    def record(self, stiffness: float, squat: float, folder: Path) -> dict[str, float]:
        """Simulate one jump, write its recording, return `trace_metrics`; stiffness [N/m], squat [deg]: command."""
        sim = self.simulation(1, with_springs(stiffness, self.length))
        trace, recorder = simulate_jump(sim, {"spring_stiffness_n_m": stiffness, "squat_command_deg": squat}, squat)
        recorder.save_rrd(folder / f"jump_{self.filter}.rrd")
        return trace_metrics(trace)

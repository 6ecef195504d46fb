"""Tests of walking with changing commands: redirected, sped up and kicked walks, and their metrics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.velocities import SETTLING_TIME, VelocityLog
from jumper_warp.utils.metrics import Metrics, MetricValue

REACH, STEP, KICK = 0.8, 0.8, 0.5
"""[m/s] and [rad/s] Limit of the commands; [m/s] step of a changed command; [m/s] step of a kicked velocity."""
RAMP, KEEP, TOLERANCE = 3.0, 5.0, 0.1
"""[s] Time of the command's ramp, time for which it is then held; [1] relative tolerance of a kept speed."""
DIRECTIONS = {"ahead": (0, 1.0, 4.0), "back": (0, -1.0, 4.0), "sideways": (1, 1.0, 2.0), "turning": (2, 1.0, 4.0)}
"""Axis, sign and highest command [m/s] or [rad/s] of the test of top speed."""
SETTLED = 0.1  # [m/s] Largest error of a robot that has settled on a new command
SMOOTHING = 0.2  # [s] Window over which velocities are averaged for the settling time
HOLD = 0.5  # [s] Time with an error below SETTLED after which a robot has settled, regardless of later pushes


def redirected_walks(env: Env, rng: np.random.Generator) -> VelocityLog:
    """Return an empty log for walks of 7 s whose commanded velocity changes after 3 s (`step_commands`)."""
    commands = step_commands(rng, env.num_envs, REACH, STEP)
    return VelocityLog(commands, env.task, 7.0, times=np.array([0.0, 3.0]))


def sped_up_walks(env: Env) -> tuple[VelocityLog, np.ndarray]:
    """Return an empty log for walks whose commanded velocity rises along one of DIRECTIONS, and these directions.

    The directions are each robot's index in DIRECTIONS, (robots,).
    """
    direction = np.arange(env.num_envs) % len(DIRECTIONS)
    commands = np.zeros((env.num_envs, 7, 3))
    for i, (axis, sign, highest) in enumerate(DIRECTIONS.values()):
        speeds = sign * np.linspace(0.3, highest, int((direction == i).sum()))
        commands[direction == i, :, axis] = speeds[:, None] * np.linspace(1.0 / 7.0, 1.0, 7)
    times = RAMP * np.arange(7) / 7.0
    return VelocityLog(commands, env.task, RAMP + 1.0 + KEEP, times=times), direction


@dataclass(kw_only=True)
class KickedWalks(VelocityLog):
    """Log of walks in which each base is kicked once: its velocity changes abruptly by `kick`."""

    kick_time: np.ndarray  # [s] (robots,) Time of the step change
    kick: np.ndarray  # [m/s] (robots, 2) Step change of the velocity, world axes

    def read_env(self, env: Env) -> dict[str, np.ndarray]:
        """Return the arrays of `VelocityLog.read_env`, and add due kicks to the bases' velocities."""
        arrays = super().read_env(env)
        kicked = np.round(self.kick_time / env.step_dt).astype(int) == len(self.velocity) + 1
        if kicked.any():
            rates = env.sim.joint_qd().copy()
            rates[kicked, :2] += self.kick[kicked]
            env.sim.state.joint_qd.assign(rates.ravel())
        return arrays


def kicked_walks(env: Env, rng: np.random.Generator) -> KickedWalks:
    """Return an empty log for walks of 7 s with a random command, and a kick in a random direction after 2 to 4 s."""
    n = env.num_envs
    commands, angle = rng.uniform(-REACH, REACH, (n, 1, 3)), rng.uniform(0.0, 2.0 * np.pi, n)
    kick = KICK * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return KickedWalks(commands, env.task, 7.0, kick_time=rng.uniform(2.0, 4.0, n), kick=kick)


def speed_metrics(walks: VelocityLog, direction: np.ndarray) -> Metrics:
    """Return the top speed that robots keep in each of DIRECTIONS, as `top_<direction>_<unit>`.

    walks, direction: of `sped_up_walks`.
    """
    metrics: Metrics = {}
    for i, (name, (axis, _, _)) in enumerate(DIRECTIONS.items()):
        unit = "rad_s" if axis == 2 else "m_s"
        kept = kept_speeds(walks, axis, KEEP, TOLERANCE)[direction == i]
        top = top_speed(np.abs(walks.commands[direction == i, -1, axis]), kept)
        metrics[f"top_{name}_{unit}"] = MetricValue(top, len(kept), None, "robots")
    return metrics


def step_commands(rng: np.random.Generator, robots: int, reach: float, step: float) -> np.ndarray:
    """Return two random commands per robot, (robots, 2, 3), whose planar velocities differ by `step` [m/s].

    All values are within ±reach; the yaw rates [rad/s] of a robot's commands are equal.
    """
    commands = np.zeros((robots, 2, 3))
    commands[..., 2] = rng.uniform(-reach, reach, robots)[:, None]
    todo = np.arange(robots)
    while len(todo):
        first = rng.uniform(-reach, reach, (len(todo), 2))
        angle = rng.uniform(0.0, 2.0 * np.pi, len(todo))
        second = first + step * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        commands[todo, 0, :2], commands[todo, 1, :2] = first, second
        todo = todo[np.abs(second).max(axis=1) > reach]
    return commands


def settling_times(walks: VelocityLog, hold: float | None = None) -> np.ndarray:
    """Return the time [s] from the last command until the planar velocity stays within SETTLED of it, (robots,).

    Velocities are means over the last SMOOTHING seconds. Infinite if a robot never settles, or falls.
    hold [s]: time for which the velocity must stay; None: to the end, so that later pushes count too.
    """
    window, first = round(SMOOTHING / walks.step_dt), round(walks.times[-1] / walks.step_dt)
    velocity = walks.velocity_history()[..., :2]
    total = np.cumsum(velocity, axis=0)
    smooth = velocity.copy()
    smooth[window:] = (total[window:] - total[:-window]) / window
    error = np.linalg.norm(smooth[first:] - walks.command_history()[first:, :, :2], axis=2)
    outside = ~(error <= SETTLED)
    if hold is not None:
        steps = min(round(hold / walks.step_dt), len(error))
        held = ~np.lib.stride_tricks.sliding_window_view(outside, steps, axis=0).any(axis=-1)
        return np.where(held.any(axis=0), held.argmax(axis=0) * walks.step_dt, np.inf)
    last = np.where(outside.any(axis=0), len(error) - np.argmax(outside[::-1], axis=0), 0)
    return np.where(last == len(error), np.inf, last * walks.step_dt)


def kept_speeds(walks: VelocityLog, axis: int, seconds: float, tolerance: float) -> np.ndarray:
    """Return which robots kept their last commanded velocity along an axis, (robots,) bool.

    A robot's velocity is the mean over the last `seconds`.
    axis: index of the component, the other two are ignored; tolerance [1]: relative error.
    """
    last = walks.velocity_history()[-round(seconds / walks.step_dt) :, :, axis].mean(axis=0)
    wanted = walks.commands[:, -1, axis]
    return np.abs(last - wanted) <= tolerance * np.abs(wanted)


def walked_fraction(walks: VelocityLog) -> np.ndarray:
    """Return the fraction, (robots,), of the commanded distance ahead that each robot walked until its fall, at most 1.

    Distance is along the robot's present heading; SETTLING_TIME at the start is not part of the commanded distance.
    """
    distance = np.nansum(walks.velocity_history()[..., 0], axis=0) * walks.step_dt
    return np.clip(distance / (walks.commands[:, 0, 0] * (walks.seconds - SETTLING_TIME)), 0.0, 1.0)


def top_speed(commanded: np.ndarray, kept: np.ndarray, share: float = 0.9, width: float = 0.1) -> float:
    """Return the highest speed that at least a fraction `share` of the robots kept, 0 if no speed was kept.

    Robots are grouped by commanded speed into bins of a width; the result is the largest command of its bin.
    commanded, width [m/s] or [rad/s]; commanded: (robots,), at least 0; kept: (robots,) bool, of `kept_speeds`.
    """
    bins, top = np.floor(commanded / width + 1.0e-9).astype(int), 0.0
    for number in np.unique(bins):
        inside = bins == number
        if kept[inside].mean() >= share:
            top = float(commanded[inside].max())
    return top

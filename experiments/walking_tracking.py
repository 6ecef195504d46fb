"""Measure how well a policy follows commanded velocities, and write metrics, a plot, a picture and a recording.

    python experiments/walking_tracking.py --policy walking_flat --commands-per-axis 13 --out outputs/walking

There are five tests:

- Tracking: a grid of commands from minus to plus 0.8 m/s, 0.8 m/s and 0.8 rad/s. Each robot gets another command of the
  grid every 3 s. For each point of the grid, one robot gets it at once and one slewed. `jumper evaluate` runs the same.
- Change: the command changes by 0.8 m/s in any direction while the robot walks. A robot has settled when it stays near
  the new command: to the end, or for half a second, regardless of later pushes.
- Top speed: the command rises over three seconds, and must be kept for five more seconds within 10 %.
- Kick: the velocity changes by 0.5 m/s in any direction.
- Gait: a straight walk at 0.8 m/s.

`--randomize` adds the randomisation, noise, latency and pushes of the training. `--solver mujoco` evaluates on physics
that the policy was not trained on.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.evaluation.velocities import AXES, VelocityFlags, VelocityLog
from jumper_warp.kernels.layout import BODIES
from jumper_warp.robot.description import LEGS
from jumper_warp.tasks.velocity.cfg import VelocityEvaluation
from jumper_warp.utils.metrics import Metrics, MetricValue, rate
from jumper_warp.viz.plots import figure
from jumper_warp.viz.style import ACTUAL_COLOR
from support.scripts import run_script


@dataclass
class GaitRecorder:
    """Recorder of the gait of all worlds (robots); call the object after every policy step.

    Lists have one array per sampled policy step; paws FL, FR, BL, BR.
    """

    env: Env  # The sampled `jumper_warp.envs.env.Env`
    skip: float = 2.0  # [s] Time at the start that is not sampled
    contact: list[np.ndarray] = field(default_factory=list)  # (robots, 4) Whether each paw is on the ground
    paw_height: list[np.ndarray] = field(default_factory=list)  # [m] (robots, 4) Height of paws above the ground
    force: list[np.ndarray] = field(default_factory=list)  # [N] (robots, 4) Upward force on paws
    torque: list[np.ndarray] = field(default_factory=list)  # [N m] (robots, 12) Motor torques
    power: list[np.ndarray] = field(default_factory=list)  # [W] (robots,) Sum of the positive powers of the motors
    speed: list[np.ndarray] = field(default_factory=list)  # [m/s] (robots,) Horizontal speed of the base
    steps: int = 0  # Number of policy steps so far, skipped ones included

    def __call__(self, *_: object) -> None:
        """Append a sample of the gait, unless within `skip` of the start."""
        self.steps += 1
        if self.steps <= round(self.skip / self.env.step_dt):
            return
        robot, sim = self.env.robot, self.env.sim
        torque = robot.torque.numpy().T.astype(float)
        rate = sim.joint_qd()[:, [6 + 5 * leg + j for leg in range(4) for j in (0, 1, 3)]]  # motor joints
        self.contact.append(robot.contact_time.numpy().T > 0.0)
        self.paw_height.append(robot.paw_height.numpy().T.copy())
        self.force.append(sim.paw_force.numpy()[..., 2].T.copy())
        self.torque.append(torque)
        self.power.append(np.maximum(torque * rate, 0.0).sum(axis=1))
        self.speed.append(np.linalg.norm(sim.base_velocity()[:, :2], axis=1))

    def metrics(self, standing: np.ndarray) -> Metrics:
        """Return the gait metrics of the robots that have not fallen, {} if there are none.

        standing: (robots,) bool, the robots that have not fallen.
        """
        if not standing.any():
            return {}
        model = self.env.sim.model
        mass = model.body_mass.numpy().reshape(-1, int(BODIES)).sum(axis=1)
        weight = (mass * np.linalg.norm(model.gravity.numpy()[: len(mass)], axis=1))[standing]
        return gait_metrics(
            np.array(self.contact)[:, standing],
            np.array(self.paw_height)[:, standing],
            np.array(self.force)[:, standing],
            np.array(self.torque)[:, standing],
            np.array(self.power)[:, standing],
            np.array(self.speed)[:, standing],
            weight,
            self.env.step_dt,
        )


def gait_metrics(
    contact: np.ndarray,
    paw_height: np.ndarray,
    force: np.ndarray,
    torque: np.ndarray,
    power: np.ndarray,
    speed: np.ndarray,
    weight: np.ndarray,
    step_dt: float,
) -> Metrics:
    """Compute step frequency, swing height, contact patterns, torques and cost of transport of walks.

    The arrays are the lists of `GaitRecorder`, (steps, robots, ...).
    weight [N]: (robots,); step_dt [s]: policy step. The cost of transport is mean power / (weight * mean speed); None
    if a robot does not move. `share_down_<paws>` is the fraction of time in which exactly these paws touch the ground.
    """
    apexes = np.concatenate(
        [
            np.zeros(0),
            *(swing_apexes(contact[:, i, k], paw_height[:, i, k]) for i in range(contact.shape[1]) for k in range(4)),
        ]
    )
    seconds = len(contact) * step_dt
    robots = max(contact.shape[1], 1)
    touchdowns = int((contact[1:] & ~contact[:-1]).sum())
    transport = power.mean(axis=0)
    load = force.sum(axis=2) / weight
    mean_speed = speed.mean(axis=0)
    metrics: dict[str, float | None] = {
        "steps_hz": touchdowns / (4.0 * robots * seconds),
        "swing_apex_median_m": float(np.median(apexes)) if len(apexes) else None,
        "cost_of_transport": float(np.mean(transport / (weight * mean_speed))) if mean_speed.min() > 0.05 else None,
        "speed_mean_m_s": float(speed.mean()),
        "torque_max_nm": float(np.abs(torque).max()),
        "torque_rms_nm": float(np.sqrt(np.mean(torque**2))),
        "paw_force_ripple": float(load.std(axis=0).mean()),
        "paw_force_max_n": float(force.max()),
    }
    codes = (contact * [1, 2, 4, 8]).sum(axis=2)  # one bit per paw
    fractions = np.bincount(codes.ravel(), minlength=16) / codes.size
    for code in np.argsort(-fractions, kind="stable"):
        if fractions[code] >= 0.005:
            paws = "_".join(leg for k, leg in enumerate(LEGS) if code >> k & 1) or "none"
            metrics[f"share_down_{paws}"] = float(fractions[code])
    return {key: MetricValue(value, contact.shape[1], None, "straight walks") for key, value in metrics.items()}


def swing_apexes(contact: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return the largest height [m] in each complete swing of one paw, (swings,); contact, height [m]: (steps,).

    A swing is complete from a lift to the next touchdown; one that the log cuts off is ignored.
    """
    edges = np.diff(contact.astype(int))
    lifts = np.flatnonzero(edges == -1) + 1
    lands = np.flatnonzero(edges == 1) + 1
    lands = lands[lands > lifts[0]] if len(lifts) else lands[:0]
    return np.array([height[a:b].max() for a, b in zip(lifts, lands, strict=False)])


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

    It rises in seven equal steps within RAMP to 0.3 up to the highest command, another one for each robot.
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
    commands = rng.uniform(-REACH, REACH, (n, 1, 3))
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
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

    Velocities are means over the last SMOOTHING seconds. Infinite if a robot never settles.
    hold [s]: time for which the velocity must stay; a robot that falls after it has settled. None: to the end, so that
    later pushes and falls count too: the velocity (steps, robots, 3) of a fallen robot is NaN.
    """
    window = round(SMOOTHING / walks.step_dt)
    first = round(walks.times[-1] / walks.step_dt)
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


def top_speed(commanded: np.ndarray, kept: np.ndarray, share: float = 0.9, width: float = 0.1) -> float:
    """Return the highest speed that at least a fraction `share` of the robots kept, 0 if no speed was kept.

    Robots are grouped by commanded speed into bins of a width; the result is the largest command of its bin.
    commanded, width [m/s] or [rad/s]; commanded: (robots,), at least 0; kept: (robots,) bool, of `kept_speeds`.
    """
    bins = np.floor(commanded / width + 1.0e-9).astype(int)
    top = 0.0
    for number in np.unique(bins):
        inside = bins == number
        if kept[inside].mean() >= share:
            top = float(commanded[inside].max())
    return top


GAIT_SPEED = 0.8  # [m/s] Speed of the straight walk whose gait is measured
PAPER = VelocityEvaluation.published
SUMMARY = (*PAPER, "fall_rate", "settling_time_median_s", "top_ahead_m_s", "kicked_fall_rate", "cost_of_transport")


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags of the tests of how well a policy follows commanded velocities."""

    policy: str = "walking_flat"
    commands_per_axis: int = 13
    """Number of commands along each of the three axes; one robot for each combination, and as many in other tests."""
    num_recorded: int = 1  # Number of robots to record for the Rerun viewer, redirected while they walk; 0: none


def plot_tracking(run: EvaluationRun, walks: VelocityLog, settling: np.ndarray) -> None:
    """Plot mean velocities over commands, and the distribution of settling times, into `tracking.png`.

    walks: of the grid; settling [s]: (robots,), infinite if a robot did not settle.
    """
    history = walks.velocity_history()[round(1.0 / walks.step_dt) : round(walks.times[1] / walks.step_dt)]
    conditions = f"{run.title}, {len(walks.end)} robots"
    with figure(run.folder / "tracking.png", 2, 2, figsize=(9, 9), title="Walking", conditions=conditions) as axes:
        for i, (axis, name) in enumerate(zip(axes.flat, AXES, strict=False)):
            commanded = walks.commands[:, 0, i]
            axis.plot([-REACH, REACH], [-REACH, REACH], color=ACTUAL_COLOR, linestyle="--", label="commanded")
            standing = ~walks.fallen
            mean = history[:, standing, i].mean(axis=0)
            axis.plot(commanded[standing], mean, ".", color=ACTUAL_COLOR, label="mean of a walk")
            label = f"{name.replace('_', ' ')} [{'rad/s' if i == 2 else 'm/s'}]"
            axis.set(xlabel=f"commanded {label}", ylabel=f"mean {label}", aspect="equal")
        times = np.sort(settling)
        axes[1, 1].step(times, np.arange(1, len(times) + 1) / len(times), where="post")
        axes[1, 1].set(
            xlabel=f"time to settle after a step of {STEP} m/s [s]", ylabel="share of robots", xlim=(0.0, 4.0)
        )


def main(args: Args) -> dict:
    """Run all tests of walking, plot tracking and settling times, and return the metrics."""
    run = EvaluationRun.from_args("walking_tracking", args, VelocityEvaluation)
    rng = np.random.default_rng(args.stream_seed)
    flags = VelocityFlags(args.commands_per_axis, (REACH, REACH, REACH))
    log = flags.log(run.task, args.stream_seed)
    walks = run.run_episodes(run.env(log.count), log)
    env = run.env(args.commands_per_axis**3)
    redirected = run.run_episodes(env, redirected_walks(env, rng), film="walk")
    settling = settling_times(redirected)
    fast, direction = sped_up_walks(env)
    run.run_episodes(env, fast)
    kicked = run.run_episodes(env, kicked_walks(env, rng))
    straight = VelocityLog(np.tile([GAIT_SPEED, 0.0, 0.0], (env.num_envs, 1, 1)), env.task)
    gait = GaitRecorder(env)
    run.run_episodes(env, straight, on_step=gait)
    plot_tracking(run, walks, settling)
    median, held = (float(np.median(times)) for times in (settling, settling_times(redirected, HOLD)))
    times = {"settling_time_median_s": median, "settling_time_for_half_a_second_median_s": held}
    return run.report(
        flags.metrics(walks)
        | {
            name: MetricValue(time if np.isfinite(time) else None, env.num_envs, None, "redirected robots")
            for name, time in times.items()
        }
        | {
            "redirected_fall_rate": rate(redirected.fallen, "redirected robots"),
            "kicked_fall_rate": rate(kicked.fallen, "kicked robots"),
        }
        | speed_metrics(fast, direction)
        | gait.metrics(~straight.fallen),
        PAPER,
        SUMMARY,
    )


if __name__ == "__main__":
    run_script(main, Args)

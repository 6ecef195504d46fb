"""Measure the state estimator's errors on recorded motions of a policy, and write metrics and a plot.

    python experiments/estimator_errors.py --policy vertical_jump --joint-offset 0.3 --out outputs/estimator
    python experiments/estimator_errors.py --policy walking --joint-offset 2

Every physics step of SolverJumper is a tick of the estimator. IMU readings have noise and a drawn bias, joint angles
noise and a drawn offset; each motion is repeated with several draws. Jumps are compared in the last tick of their
longest flight, walking from half a second on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from jumper_warp.deploy.estimator import GRAVITY, IDENTITY, Estimator, quaternion_of, skew
from jumper_warp.evaluation.jumps import jump_commands
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.sim.simulation import motor_values
from jumper_warp.tasks.evaluation import Evaluation
from jumper_warp.tasks.jump.evaluation import HeightEvaluation, PlaceEvaluation
from jumper_warp.utils.metrics import Metrics, MetricValue
from jumper_warp.viz.plots import figure
from support.scripts import run_script

STILL = 60  # Policy steps in the default pose before the policy acts
REST = 470  # Ticks after the reset, within them; readings of the last 96 are averaged for the start
GYRO_NOISE, ACCEL_NOISE = 3.0e-4, 2.0e-3  # [rad/s/√Hz], [m/s^2/√Hz]
GYRO_BIAS, ACCEL_BIAS = 5.0e-3, 0.03  # [rad/s], [m/s^2] Standard deviations
ANGLE_NOISE, RATE_NOISE, TORQUE_NOISE = 4.0e-4, 0.05, 0.2  # [rad], [rad/s], [N m]


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags of the test of the estimator."""

    num_motions: int = 8  # Number of simulated robots, with different commands
    num_draws: int = 16  # Number of draws of the sensors' errors for each
    joint_offset: float = 0.3  # [deg] Standard deviation of the offset of each joint angle
    seconds: float = 3.2  # [s] Simulated time
    wait: float = 1.5  # [s] Time before a jump is commanded


def matrix_of(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4), xyzw."""
    cross = skew(quaternion[..., :3])
    return IDENTITY + 2.0 * quaternion[..., 3, None, None] * cross + 2.0 * cross @ cross


class Ticks:
    """Recorder of every physics step of an environment."""

    def __init__(self, sim: Any) -> None:
        """Replace the simulation's `advance` by one that records after each physics step."""
        self.sim = sim
        self.states: list[tuple[np.ndarray, ...]] = []
        self._advance = sim.advance
        sim.advance = self.advance
        self.record()

    def record(self) -> None:
        """Append coordinates, rates, motor torques and whether each paw has contact."""
        sim = self.sim
        touch = np.linalg.norm(sim.paw_force.numpy(), axis=2).T > 0.0
        self.states.append((sim.joint_q().copy(), sim.joint_qd().copy(), sim.torque.numpy().T.copy(), touch))

    def advance(self, substeps: int, *targets: Any, **settings: Any) -> None:
        """Advance in single physics steps."""
        for _ in range(substeps):
            self._advance(1, *targets, **settings)
            self.record()


def record(run: EvaluationRun, args: Args) -> dict[str, np.ndarray]:
    """Simulate the motions and return true states by name, (ticks, num_motions, ...)."""
    env = run.env(args.num_motions)
    count = args.num_motions
    if isinstance(run.evaluation, (HeightEvaluation, PlaceEvaluation)):
        goals = np.zeros((count, 3))
        up = isinstance(run.evaluation, HeightEvaluation)
        goals[:, 2 if up else 0] = np.linspace(*((0.6, 1.1) if up else (0.4, 1.3)), count)
        commands = jump_commands(goals, args.wait, env.step_dt)
    else:
        commands = np.random.default_rng(args.stream_seed).uniform([-0.4, -0.2, -0.5], [0.8, 0.2, 0.5], (count, 3))
    env.evaluation_reset(commands)
    ticks = Ticks(env.sim)
    act = run.actor(env)
    for i in range(round(args.seconds / env.step_dt)):
        env.action.copy_(act(env.obs) * (i >= STILL))
        for stage in env.stages().values():
            stage()
    q, qd, torque, contact = (np.array(values) for values in zip(*ticks.states, strict=True))
    rot = matrix_of(q[..., 3:7].astype(float))
    com = env.sim.model.body_com.numpy()[0]
    vel = qd[..., :3] - np.cross(qd[..., 3:6], rot @ com)
    return {"pos": q[..., :3], "rot": rot, "vel": vel, "q": motor_values(q[..., 7:]), "qd": motor_values(qd[..., 6:]),
            "torque": torque, "contact": contact, "dt": np.array(env.sim.dt)}  # fmt: skip


def imu(true: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the means of angular rate [rad/s] and specific force [m/s^2] over each tick, body frame."""
    dt = float(true["dt"])
    turn = quaternion_of(np.swapaxes(true["rot"][:-1], -1, -2) @ true["rot"][1:])
    turn *= np.copysign(1.0, turn[..., 3:])
    force = np.diff(true["vel"], axis=0) / dt - GRAVITY
    middle = true["rot"][:-1] + true["rot"][1:]
    return 2.0 * turn[..., :3] / dt, 0.5 * (np.swapaxes(middle, -1, -2) @ force[..., None])[..., 0]


def readings(true: dict[str, np.ndarray], args: Args) -> dict[str, np.ndarray]:
    """Return readings with drawn errors, (ticks, num_motions * num_draws, ...), a motion's draws in sequence."""
    random = np.random.default_rng(args.stream_seed + 1)
    gyro, accel = imu(true)
    root = float(true["dt"]) ** -0.5
    sources = {
        "gyro": (gyro, GYRO_NOISE * root, GYRO_BIAS), "accel": (accel, ACCEL_NOISE * root, ACCEL_BIAS),
        "q": (true["q"][1:], ANGLE_NOISE, np.deg2rad(args.joint_offset)), "qd": (true["qd"][1:], RATE_NOISE, 0.0),
        "torque": (true["torque"][1:], TORQUE_NOISE, 0.0),
    }  # fmt: skip
    result = {}
    for name, (values, noise, bias) in sources.items():
        values = values.repeat(args.num_draws, axis=1)
        result[name] = values + random.normal(0.0, noise, values.shape) + random.normal(0.0, bias, values.shape[1:])
    return result


def errors(true: dict[str, np.ndarray], data: dict[str, np.ndarray], args: Args) -> dict[str, np.ndarray]:
    """Run the estimator and return errors by name, (ticks, robots): velocity [m/s], height [m], tilt [deg]."""
    estimator = Estimator()
    estimator.reset(*(data[name][REST - 96 : REST].mean(0) for name in ("gyro", "accel", "q")))
    names = ("velocity", "height", "tilt", "diverged", "contact", "wrong_contact")
    found: dict[str, list] = {name: [] for name in names}
    for i in range(REST, len(data["q"])):
        readings = (data[name][i] for name in ("gyro", "accel", "q", "qd", "torque"))
        estimate = estimator.update(*readings, dt=float(true["dt"]))
        pos, vel, rot, contact = (
            true[name][i + 1].repeat(args.num_draws, axis=0) for name in ("pos", "vel", "rot", "contact")
        )
        # the yaw of the start is unknown; velocities are compared in the body frame
        turn = matrix_of(estimate.quaternion)
        body = [(v[:, None] @ r)[:, 0] for r, v in ((turn, estimate.velocity), (rot, vel))]
        up = np.clip((turn[:, 2] * rot[:, 2]).sum(-1), -1.0, 1.0)
        values = (
            np.linalg.norm(body[0] - body[1], axis=-1), estimate.position[:, 2] - pos[:, 2], np.rad2deg(np.arccos(up)),
            estimate.diverged, estimate.contact, (estimate.contact != contact).mean(-1),
        )  # fmt: skip
        for name, value in zip(names, values, strict=True):
            found[name].append(value)
    return {name: np.array(values) for name, values in found.items()}


def landing(contact: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the last tick of each motion's longest flight, and its ticks, (num_motions,); contact: (ticks, n, 4)."""
    length = np.zeros(contact.shape[1], dtype=int)
    best = np.zeros_like(length)
    last = np.zeros_like(length)
    for i, touch in enumerate(np.asarray(contact.any(-1))):
        length = np.where(touch, 0, length + 1)
        last = np.where(length > best, i, last)
        best = np.maximum(best, length)
    return last, best


def main(args: Args) -> dict:
    """Record motions, estimate, plot the errors and return the metrics."""
    run = EvaluationRun.from_args("estimator_errors", args, Evaluation)
    true = record(run, args)
    found = errors(true, readings(true, args), args)
    jumps = isinstance(run.evaluation, (HeightEvaluation, PlaceEvaluation))
    count = found["tilt"].shape[1]
    last, ticks = landing(true["contact"][REST + 1 :])
    robots, samples = np.arange(count), np.arange(240, len(found["tilt"]))
    rows, columns = (
        (last.repeat(args.num_draws), robots) if jumps else (g.ravel() for g in np.meshgrid(samples, robots))
    )
    metrics: Metrics = {"flight_max_s": MetricValue(ticks.max() * float(true["dt"]))}
    for name, unit in (("velocity", "m_s"), ("height", "m"), ("tilt", "deg")):
        values = np.abs(found[name][rows, columns])
        metrics[f"{name}_rms_{unit}"] = MetricValue(float(np.sqrt((values**2).mean())), count, over="robots")
        metrics[f"{name}_p95_{unit}"] = MetricValue(float(np.quantile(values, 0.95)), count, over="robots")
    metrics["wrong_contact_rate"] = MetricValue(float(found["wrong_contact"].mean()))
    metrics["diverged_rate"] = MetricValue(float(found["diverged"].any(0).mean()), count, over="robots")
    time = np.arange(len(found["tilt"])) * float(true["dt"])
    with figure(run.folder / "errors.png", 1, 3, figsize=(14, 5), title="Estimator", conditions=run.title) as axes:
        for axis, (name, unit) in zip(axes, (("velocity", "m/s"), ("height", "m"), ("tilt", "deg")), strict=True):
            axis.plot(time, np.quantile(np.abs(found[name]), [0.5, 0.95], axis=1).T)
            axis.set(xlabel="time [s]", ylabel=f"error of {name} [{unit}]", title="median and 95 %")
    run.settings |= {"joint_offset_deg": args.joint_offset, "draws": args.num_draws}
    return run.report(metrics, {}, list(metrics))


if __name__ == "__main__":
    run_script(main, Args)

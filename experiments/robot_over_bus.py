"""Does the runtime over simulated CAN buses lose jumps or walks? Each trial is paired with direct simulation.

    python experiments/robot_over_bus.py --jumps 500 --walk-minutes 20 --courses 50 --out outputs/robot_over_bus

In lockstep: the runtime's frames pass Unix datagrams to `BusSim`. Direct simulation runs the same skills each 1/60 s on
the true state, with the motors' torque limits. `--drop 0.01` loses frames, `--delay 0.5` delays commands by a tick,
`--rate 500` changes the motor loop. `--estimator` replaces the motion capture by the estimator, with noise and drawn
biases of the IMU and offsets of the joints. The script writes `metrics.json`.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from jumper_warp.bench.bundle import export_bundle
from jumper_warp.bench.bus_sim import CONTACT_FORCE, BusSim, make_simulation
from jumper_warp.bench.faults import BusFaults
from jumper_warp.deploy.bundle import Bundle
from jumper_warp.deploy.bus import Link, open_buses
from jumper_warp.deploy.estimator import Estimator
from jumper_warp.deploy.runtime import ENTER_TICKS, Request, Runtime, State
from jumper_warp.deploy.sensors import Estimate, MotionCapture
from jumper_warp.deploy.skills import Motion, Walk, rotate
from jumper_warp.policies.policy import load_policy
from jumper_warp.robot.motors import jumping_motors, walking_motors
from jumper_warp.sim.simulation import Simulation, motor_values
from jumper_warp.utils.files import json_bytes, write_atomically
from jumper_warp.utils.output import output_dir
from support.scripts import OutputArgs, run_script

POLICIES = {State.JUMP_UP: "vertical_jump", State.JUMP_TO: "horizontal_jump", State.WALK: "walking"}
TOLERANCE = 0.1  # [m] of apex and landing
LOWEST, MOST_TILT = 0.10, np.radians(60.0)  # [m], [rad] height and tilt of a base beyond which it has fallen
GYRO_NOISE, ACCEL_NOISE = 3.0e-4, 2.0e-3  # [rad/s/√Hz], [m/s^2/√Hz]
GYRO_BIAS, ACCEL_BIAS, JOINT_OFFSET = 5.0e-3, 0.03, np.radians(0.3)  # [rad/s], [m/s^2], [rad] standard deviations
COMMAND_SECONDS = 3.0  # [s] for which each random velocity is commanded


@dataclass(frozen=True)
class Args(OutputArgs):
    """Flags of the trials over the bus."""

    jumps: int = 50  # Number of jumps up, and of jumps to a place
    walk_minutes: float = 1.0  # [min] Robot time of walking
    courses: int = 5  # Number of courses: walk, jump up, walk, jump to a place, walk
    drop: float = 0.0  # Probability that a frame is lost
    delay: float = 0.0  # Probability that a command arrives a tick late
    rate: int = 480  # Ticks of the motor loop a second: 480 or 500
    estimator: bool = False  # Use the estimator instead of the motion capture
    seed: int = 0


class Bench:
    """A runtime on simulated buses, and a direct simulation of each skill."""

    def __init__(self, args: Args, folder: Path) -> None:
        """Export the bundle to `folder` and connect both ends."""
        export_bundle([(name, load_policy(name)) for name in POLICIES.values()], folder)
        self.args = args
        self.bundle = Bundle(folder)
        noise = np.sqrt(args.rate) * np.array([GYRO_NOISE, ACCEL_NOISE] if args.estimator else [0.0, 0.0])
        faults = BusFaults(args.drop, delay=args.delay, gyro_noise=noise[0], accel_noise=noise[1])
        self.rng = np.random.default_rng(args.seed + 1)
        self.far = BusSim(open_buses(f"unix:{folder}/bus", "robot"), faults, sim=make_simulation(1.0 / args.rate))
        self.link = Link(open_buses(f"unix:{folder}/bus"), pump=self.far.serve)
        self.direct = {
            State.JUMP_UP: Simulation(1, motors=jumping_motors(18.0, lateral_torque=10.0), friction=0.85, device="cpu"),
            State.JUMP_TO: Simulation(1, motors=jumping_motors(18.0, lateral_torque=12.0), friction=0.85, device="cpu"),
            State.WALK: Simulation(1, motors=walking_motors(), friction=0.85, device="cpu"),
        }

    def runtime(self) -> Runtime:
        """Return a runtime whose robot stands in the default pose, with motors on."""
        self.far.restart()
        if self.args.estimator:
            self.far.imu_bias = self.rng.normal(0.0, [[GYRO_BIAS], [ACCEL_BIAS]], (2, 3))
            self.far.bias[0] = self.rng.normal(0.0, JOINT_OFFSET, 12)
        source = Estimator() if self.args.estimator else MotionCapture()
        runtime = Runtime(self.bundle, self.link, source, rate=self.args.rate)
        while runtime.state == State.PASSIVE:  # until it has been at rest for long enough
            self.far.restart()  # stand at rest while the motors are off
            runtime.tick(Request.STAND)
        for _ in range(ENTER_TICKS):
            runtime.tick()
        return runtime

    def over_bus(self, state: State, commands: np.ndarray, steps: int) -> dict[str, np.ndarray]:
        """Run a skill with a command every `steps` policy steps, and return its trajectory by policy step.

        commands: (n, 3). Of walking: velocity ahead and to the left [m/s], yaw rate [rad/s]; of a jump up: height of
        the apex [m]; of a jump to a place: ahead and to the left [m]. Unused components are 0.
        """
        runtime = self.runtime()
        runtime._enter(state, commands[0])
        rows = []
        for command in commands:
            if state == State.WALK:
                runtime.tick(Request.WALK, command)
            for _ in range(steps):
                for _ in range(round(self.args.rate / 60)):
                    runtime.tick()
                rows.append([*self.far.q[:7], *self.far.velocity])
                if runtime.state != state:  # a jump ends, or a fault
                    break
            if runtime.state == State.DAMP:
                print(f"{state.name} {command}: {runtime.reason.name}")
                break
        return trajectory(rows)

    def directly(self, state: State, commands: np.ndarray, steps: int) -> dict[str, np.ndarray]:
        """Run a skill in direct simulation; arguments and result as in `over_bus`.

        All `len(commands) * steps` policy steps are run. `over_bus` leaves a command early when a jump ends or a fault
        occurs. The `Runtime` only loads the skills: `tick` is never called.
        """
        sim = self.direct[state]
        sim.reset()
        runtime = Runtime(self.bundle, self.link)
        skill, motion, rows = runtime.skills[state], Motion(self.bundle.settings["switch"], 1.0 / 60.0), []
        read_state(sim, motion)
        skill.begin(commands[0], motion, self.bundle.default)
        for command in commands:
            if state == State.WALK:
                cast("Walk", skill).wanted = command
            for _ in range(steps):
                read_state(sim, motion)
                sim.set_targets(skill.targets(motion))
                sim.step()
                rows.append([*sim.joint_q()[0, :7], *sim.base_velocity()[0]])
        return trajectory(rows)

    def heading(self) -> np.ndarray:
        """Return the quaternion of the robot's true yaw."""
        ahead = rotate(self.far.q[3:7], np.array([1.0, 0.0, 0.0]))
        half = 0.5 * np.arctan2(ahead[1], ahead[0])
        return np.array([0.0, 0.0, np.sin(half), np.cos(half)])

    def course(self, values: np.ndarray) -> bool:
        """Run a course over the bus, and return whether it succeeds.

        There must be no fault, and each jump must end in walking within 12 s, with its apex or place within TOLERANCE.
        values: height of the apex [m], place ahead and to the left of the base [m], two walking speeds [m/s].
        """
        runtime = self.runtime()
        runtime._enter(State.WALK)
        for request, command in (
            (Request.WALK, (values[3], 0.0, 0.2)), (Request.JUMP_UP, (values[0], 0.0, 0.0)),
            (Request.WALK, (values[4], 0.1, -0.2)), (Request.JUMP_TO, (values[1], values[2], 0.0)),
            (Request.WALK, (0.4, 0.0, 0.0)),
        ):  # fmt: skip
            jumps = request != Request.WALK
            runtime.tick(request, command)
            apex, jumped, place = 0.0, False, None
            for _ in range(round((12.0 if jumps else 2.0) * self.args.rate)):
                runtime.tick()
                if runtime.state in (State.JUMP_UP, State.JUMP_TO):
                    if not jumped:
                        place = (self.far.q[:3] + rotate(self.heading(), np.array([*command[:2], 0.0])))[:2]
                    jumped = True
                    apex = max(apex, self.far.q[2])
                if runtime.state == State.DAMP or (jumped and runtime.state == State.WALK):
                    break
            error = abs(apex - values[0]) if request == Request.JUMP_UP else 0.0
            if request == Request.JUMP_TO and place is not None:
                error = float(np.linalg.norm(self.far.q[:2] - place))
            if runtime.state != State.WALK or (jumps and not jumped) or error > TOLERANCE:
                return False
        return True


def read_state(sim: Simulation, motion: Motion) -> None:
    """Give the true state of a simulation to a motion."""
    q, qd = sim.joint_q()[0].copy(), sim.joint_qd()[0].copy()
    contact = np.linalg.norm(sim.paw_force.numpy()[:, 0], axis=-1) > CONTACT_FORCE
    estimate = Estimate(q[:3], sim.base_velocity()[0], q[3:7], contact, False)
    motion.update(estimate, rotate(q[3:7], qd[3:6], inverse=True), motor_values(q[7:]), motor_values(qd[6:]))


def trajectory(rows: list) -> dict[str, np.ndarray]:
    """Return the rows of a trajectory by name."""
    names = ("position", "quaternion", "velocity", "spin")
    return dict(zip(names, np.split(np.array(rows), [3, 7, 10], axis=1), strict=True))


def fallen(run: dict[str, np.ndarray]) -> bool:
    """Return whether the robot falls in a trajectory: its base is too low or tilted."""
    x, y = run["quaternion"][:, :2].T
    return bool(run["position"][:, 2].min() < LOWEST or (1.0 - 2.0 * (x**2 + y**2)).min() < np.cos(MOST_TILT))


def jump_error(state: State, command: np.ndarray, run: dict[str, np.ndarray]) -> float:
    """Return the error of a jump's apex or place [m], infinite after a fall."""
    position = run["position"]
    if fallen(run):
        return np.inf
    if state == State.JUMP_UP:
        return abs(float(position[:, 2].max()) - command[0])
    return float(np.linalg.norm(position[-1, :2] - position[0, :2] - command[:2]))


def tracking_error(run: dict[str, np.ndarray], commands: np.ndarray, steps: int) -> float:
    """Return the RMS error of the walking velocity [m/s], a second after each command; infinite after a fall."""
    if fallen(run):
        return np.inf
    errors = []
    for i in range(len(run["position"])):
        if i % steps >= 60:
            body = rotate(run["quaternion"][i], run["velocity"][i], inverse=True)
            errors.append(body[:2] - commands[i // steps, :2])
    return float(np.sqrt(np.mean(np.square(errors))))


def main(args: Args) -> dict:
    """Run the trials, and return success and errors over the bus and in direct simulation."""
    rng = np.random.default_rng(args.seed)
    metrics: dict = {}
    with tempfile.TemporaryDirectory() as name:
        bench = Bench(args, Path(name))
        for state, low, high in (
            (State.JUMP_UP, (0.5, 0.0, 0.0), (1.0, 0.0, 0.0)), (State.JUMP_TO, (-0.4, -0.4, 0.0), (1.4, 0.4, 0.0)),
        ):  # fmt: skip
            commands = rng.uniform(low, high, (args.jumps, 3))
            errors = [
                [jump_error(state, command, run(state, command[None], 150)) for run in (bench.over_bus, bench.directly)]
                for command in commands
            ]
            metrics |= summary(POLICIES[state], np.array(errors).reshape(-1, 2))
        steps = round(60.0 * COMMAND_SECONDS)
        minutes = []
        for _ in range(round(args.walk_minutes * 2.0)):
            commands = rng.uniform((-0.5, -0.3, -0.8), (1.0, 0.3, 0.8), (10, 3))
            runs = [run(State.WALK, commands, steps) for run in (bench.over_bus, bench.directly)]
            minutes.append([tracking_error(run, commands, steps) for run in runs])
        metrics |= summary("walking", np.array(minutes).reshape(-1, 2), tolerance=np.finfo(float).max)
        low, high = (0.6, 0.3, -0.2, 0.2, 0.2), (0.95, 1.0, 0.2, 0.8, 0.8)
        courses = [bench.course(rng.uniform(low, high)) for _ in range(args.courses)]
        metrics |= {"courses": len(courses), "courses_done": int(np.sum(courses))}
        metrics["largest_torque_over_limit_Nm"] = bench.far.largest_torque.tolist()
    write_atomically(output_dir("robot_over_bus", args.out) / "metrics.json", json_bytes(metrics))
    print(json_bytes(metrics).decode())
    return metrics


def summary(name: str, errors: np.ndarray, tolerance: float = TOLERANCE) -> dict:
    """Return success and mean error of trials, columns over the bus and direct; an error is infinite after a fall."""
    result: dict = {f"{name}_trials": len(errors)}
    for column, where in enumerate(("bus", "direct")):
        values = errors[:, column]
        result[f"{name}_{where}_success"] = float(np.mean(values <= tolerance)) if len(values) else 0.0
        finite = values[np.isfinite(values)]
        result[f"{name}_{where}_mean_error"] = float(finite.mean()) if len(finite) else 0.0
    return result


if __name__ == "__main__":
    run_script(main, Args)

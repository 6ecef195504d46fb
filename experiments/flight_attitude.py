"""Compare landings on Mars with and without a policy that levels the robot in flight, and write metrics and plots.

    python experiments/flight_attitude.py --policy attitude --num-flights 100 --out outputs/flight
    python experiments/flight_attitude.py --takeoff policy --landing-policy mars_vertical_jump --randomize

Robots squat and extend their legs (24.8 N m, kp 20, 3.71 m/s^2). Some legs extend a few milliseconds later than others,
so that robots take off tilted and rotating. In flight a policy trained in zero gravity turns the robot to level. The
landing begins 0.35 s before touchdown, with the policy `--landing-policy` or in the default pose. A landing succeeds if
only paws touch the ground and the base is within 30 degrees of level 1.5 s later. The same takeoffs without turning are
the comparison. With `--takeoff policy` the landing policy also takes off, half a second after the start. A recording
and a picture show one flight of each kind.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.conditions import shared_robot
from jumper_warp.evaluation.jumps import DELAY, jump_commands
from jumper_warp.evaluation.log import NO_END, EvaluationLog, ended_by, listed
from jumper_warp.evaluation.run import EvaluationArgs, Run, conditions_of
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.spec import PolicyError
from jumper_warp.registry import make_task
from jumper_warp.tasks.switching import FALLS_FROM_FLIGHT, flight_skills
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json
from jumper_warp.utils.metrics import Metrics, largest, mean, rate
from jumper_warp.utils.rotations import yaw_of
from jumper_warp.viz.plots import figure
from support.momentum import momentum
from support.scripts import run_script

JUMP, TURN = 0, 1  # Indices of the skills in `Env.skills`
RAMP, HOLD, EXTEND = 25, 35, 40  # Policy steps of the ramp into the squat, the held squat, at most of the extension
SQUAT = 120.0  # [deg] Commanded transversal angle of the squat
STRETCHED = -45.0  # [deg] Commanded transversal angle of the extension
HIGH = 0.7  # [m] Base height above which no paw can touch level ground
UPRIGHT = 30.0  # [deg] Largest tilt of a successful landing
CLEAR = 3  # Policy steps without contact that count as takeoff of a policy; open loop, one is enough
AFTER = 1.5  # [s] Time after touchdown at which a landing is evaluated
OUTCOMES = (*(term.name for term in FALLS_FROM_FLIGHT), "landed", "tilted", "no_takeoff")
"""Outcomes by index `FlightLog.end`."""
LEG_SIGNS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
"""Sides of the legs FL, FR, BL, BR: 1 front or left, -1 back or right; columns: front, left."""


@dataclass
class FlightLog(EvaluationLog):
    """Log of one flight per world; arrays have shape (num_envs,) and do not change after the flight's end."""

    apex: np.ndarray  # [m] (num_envs,) Apex heights commanded to the jump's policy
    late: np.ndarray | None = None  # [s] (num_envs, 2) Delays of front and left legs; None: the policy takes off
    turns: bool = True  # Whether the turning skill is requested in flight
    seconds: float = 9.0  # [s] Maximum simulated time
    row_name = "flight"
    spacing = 1.6

    def __post_init__(self) -> None:
        """Allocate results of one flight per world, NaN or -1 until they are known."""
        n = self.count = len(self.apex)
        self.step_dt = 1.0 / 60.0  # [s] policy step; `begin` sets that of the environment
        self.end = np.full(n, -1)  # index in OUTCOMES, -1 while under way
        self.takeoff_tilt, self.takeoff_spin = (np.full(n, np.nan) for _ in range(2))  # [rad], [rad/s] at takeoff
        self.takeoff_momentum = np.full(n, np.nan)  # [kg m^2/s] norm of the angular momentum about the COM at takeoff
        self.largest_tilt = np.zeros(n)  # [rad] in flight
        self.touchdown_tilt = np.full(n, np.nan)  # [rad] in the step before the touchdown
        self.touchdown_turn = np.full(n, np.nan)  # [rad] size of the yaw from the start, in the step before touchdown
        self.height = np.zeros(n)  # [m] largest base height
        self.flight_time = np.full(n, np.nan)  # [s] from takeoff to touchdown
        self.drift = np.zeros(n)  # [kg m^2/s] largest change of the angular momentum above HIGH
        self.tilts: list[np.ndarray] = []  # [rad] (num_envs,) after every policy step, until the end
        self.heights: list[np.ndarray] = []  # [m] (num_envs,) base height after every policy step
        self._takeoff_step = np.full(n, -1)
        self._touchdown_step = np.full(n, -1)
        self._airborne_steps = np.zeros(n, dtype=int)
        self._yaw = np.zeros(n)
        self._initial_momentum = np.zeros((n, 3))

    def begin(self, env: Env) -> None:
        """Reset every robot to the default pose, with its commanded apex height."""
        self.step_dt = env.step_dt
        goals = np.zeros((len(self.apex), 3))
        goals[:, 2] = self.apex
        env.evaluation_reset(jump_commands(goals, DELAY if self.late is None else 0.0, env.step_dt))

    def open_loop(self, late: np.ndarray) -> np.ndarray:
        """Return the transversal motor angles [deg] of the open-loop takeoff at the next policy step.

        A leg that extends a fraction of a policy step late gets the same fraction less of its extension in that step.
        The default pose has 45 degrees. The result is (num_envs, 4), legs FL, FR, BL, BR.
        late: the field `late`.
        """
        step = len(self.tilts)
        n = len(self.apex)
        squat = 45.0 + (SQUAT - 45.0) * min(step / RAMP, 1.0)
        delay = late @ (0.5 * LEG_SIGNS.T) / self.step_dt  # [policy steps]
        extended = np.clip(step + 1 - (RAMP + HOLD) - (delay - delay.min(axis=1, keepdims=True)), 0.0, 1.0)
        if step < RAMP + HOLD + EXTEND:
            return squat + (STRETCHED - squat) * extended
        return np.full((n, 4), 45.0)

    def action(self, scale: float, policy: torch.Tensor | None) -> np.ndarray:
        """Return the jump's action [1], (num_envs, 12): open loop up to takeoff if `late` is set, else of the policy.

        scale [deg]: action scale of the transversal motors; policy: action of the policy (num_envs, 12), None: the
        default pose.
        """
        n = len(self.apex)
        action = np.zeros((n, 12)) if policy is None else policy.cpu().numpy().copy()
        if self.late is None:
            return action
        pushing = self._takeoff_step < 0
        legs = np.zeros((n, 4, 3))
        legs[:, :, 1:] = ((self.open_loop(self.late) - 45.0) / scale)[:, :, None]
        action[pushing] = legs.reshape(n, 12)[pushing]
        return action

    def read_env(self, env: Env) -> dict[str, np.ndarray]:
        """Return the robots' motion, contacts and termination by name for `update`, (num_envs, ...), world axes.

        base_pos [m], tilt [rad], turn (size of the yaw [rad]), rise (upward speed [m/s]), spin (angular speed [rad/s]),
        down (whether any paw is on the ground), termination (index), momentum (angular, about the COM [kg m^2/s]).
        """
        q = env.sim.joint_q()
        qd = env.sim.joint_qd()
        quat = q[:, 3:7]
        up = 1.0 - 2.0 * (quat[:, 0] ** 2 + quat[:, 1] ** 2)
        forces = np.linalg.norm(env.sim.paw_force.numpy(), axis=2)
        return {"base_pos": q[:, :3].copy(), "tilt": np.arccos(np.clip(up, -1.0, 1.0)), "turn": np.abs(yaw_of(quat)),
                "rise": qd[:, 2].copy(), "spin": np.linalg.norm(qd[:, 3:6], axis=1), "down": (forces > 0.1).any(axis=0),
                "termination": env.episodes.termination.numpy().copy(), "momentum": momentum(env.sim)[1]}  # fmt: skip

    def record_step(self, env: Env) -> bool:
        """Record a policy step; return whether all flights have ended.

        If `turns`, request the turning skill for robots that took off in this step.
        """
        before = self._takeoff_step.copy()
        ended = super().record_step(env)
        took_off = (self._takeoff_step >= 0) & (before < 0)
        if self.turns and took_off.any():
            env.request(TURN, took_off)
        return ended

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Record a policy step from the arrays of `read_env`; return whether all flights have ended.

        A flight ends with a fall, AFTER seconds after touchdown, or without a takeoff by the end of the extension. A
        takeoff is a step in which the robot rises without contact: paws of a robot that falls over lose contact too.
        """
        step = len(self.tilts)
        running = self.end < 0
        self._airborne_steps = np.where(arrays["down"], 0, self._airborne_steps + 1)
        earliest, needed = (0, CLEAR) if self.late is None else (RAMP + HOLD, 1)
        rising = (self._airborne_steps >= needed) & (arrays["rise"] > 0.75) & (step >= earliest)
        left = running & (self._takeoff_step < 0) & rising
        self._takeoff_step[left] = step
        for name, key in (("takeoff_tilt", "tilt"), ("takeoff_spin", "spin")):
            getattr(self, name)[left] = arrays[key][left]
        self.takeoff_momentum[left] = np.linalg.norm(arrays["momentum"][left], axis=1)
        self._initial_momentum[left] = arrays["momentum"][left]
        landed = running & (self._takeoff_step >= 0) & (self._touchdown_step < 0) & arrays["down"]
        self._touchdown_step[landed] = step
        self.touchdown_tilt[landed] = self.tilts[-1][landed] if self.tilts else np.nan
        self.touchdown_turn[landed] = self._yaw[landed]
        self._yaw = arrays["turn"]
        self.flight_time[landed] = (step - self._takeoff_step[landed]) * step_dt
        flying = running & (self._takeoff_step >= 0) & (self._touchdown_step < 0)
        self.largest_tilt[flying] = np.maximum(self.largest_tilt, arrays["tilt"])[flying]
        change = np.linalg.norm(arrays["momentum"] - self._initial_momentum, axis=1)
        high = flying & (arrays["base_pos"][:, 2] > HIGH)
        self.drift[high] = np.maximum(self.drift, change)[high]
        self.height[running] = np.maximum(self.height, arrays["base_pos"][:, 2])[running]
        for history, value in ((self.tilts, arrays["tilt"]), (self.heights, arrays["base_pos"][:, 2])):
            history.append(np.where(running, value, history[-1]) if history else value)
        fell = running & (arrays["termination"] >= 0)
        self.end[fell] = arrays["termination"][fell]
        over = running & ~fell & (self._touchdown_step >= 0) & (step - self._touchdown_step >= round(AFTER / step_dt))
        upright = np.degrees(arrays["tilt"]) < UPRIGHT
        self.end[over] = np.where(upright[over], OUTCOMES.index("landed"), OUTCOMES.index("tilted"))
        late = running & (self._takeoff_step < 0) & (step > RAMP + HOLD + EXTEND)
        self.end[late] = OUTCOMES.index("no_takeoff")
        return bool((self.end >= 0).all())

    @property
    def success(self) -> np.ndarray:
        """Whether each robot landed and was nearly level (within UPRIGHT) AFTER seconds later, (num_envs,)."""
        return self.end == OUTCOMES.index("landed")

    @property
    def outcomes(self) -> np.ndarray:
        """Outcome of each flight, one of OUTCOMES or NO_END, (num_envs,)."""
        return np.array([*OUTCOMES, NO_END])[self.end]

    def columns(self) -> dict[str, list]:
        """Return takeoff tilt and spin, touchdown tilt, apex height and outcome of all flights, as lists by name."""
        columns = {
            "takeoff_tilt_deg": np.degrees(self.takeoff_tilt), "takeoff_spin_rad_s": self.takeoff_spin,
            "touchdown_tilt_deg": np.degrees(self.touchdown_tilt), "apex_m": self.height,
        }  # fmt: skip
        return listed(columns | {"end": self.outcomes})

    def series(self) -> dict[str, np.ndarray]:
        """Return the last tilt [deg] and base height [m] of all worlds."""
        return {"tilt/of {} [deg]": np.degrees(self.tilts[-1]), "height/base of {} [m]": self.heights[-1]}

    def notes(self, worlds: Sequence[int]) -> Json:
        """Return commanded apex heights `asked_m` of some worlds, and `late_ms`, the delays of front and left legs."""
        notes = {"asked_m": self.apex[list(worlds)].tolist()}
        return notes if self.late is None else notes | {"late_ms": (1000.0 * self.late[list(worlds)]).tolist()}


def flight_metrics(flights: FlightLog) -> Metrics:
    """Return the rate of upright landings, and tilts, spins, momenta and apexes of the flights as metrics.

    Means are over the flights that took off or touched down.
    """
    up = "flights that took off"
    down = "flights that touched down"
    each = "flights"
    touchdown_tilt = np.degrees(flights.touchdown_tilt)
    touchdown_turn = np.degrees(flights.touchdown_turn)
    error = {"apex_error_abs_mean_m": mean(abs(flights.height - flights.apex), each)}
    return {
        "landed_upright_rate": rate(flights.success, each),
        **ended_by(flights.outcomes, each),
        "takeoff_tilt_mean_deg": mean(np.degrees(flights.takeoff_tilt), up),
        "takeoff_spin_mean_rad_s": mean(flights.takeoff_spin, up),
        "takeoff_angular_momentum_mean_nm_s": mean(flights.takeoff_momentum, up),
        "angular_momentum_change_in_flight_max_nm_s": largest(flights.drift, each),
        "flight_time_mean_s": mean(flights.flight_time, down),
        "apex_mean_m": mean(flights.height, each),
        **(error if flights.late is None else {}),
        "largest_tilt_mean_deg": mean(np.degrees(flights.largest_tilt), each),
        "touchdown_tilt_mean_deg": mean(touchdown_tilt, down),
        "touchdown_tilt_max_deg": largest(touchdown_tilt, down),
        "touchdown_turn_mean_deg": mean(touchdown_turn, down),
        "touchdown_turn_max_deg": largest(touchdown_turn, down),
        "failed_before_touchdown_rate": rate(~flights.success & np.isnan(flights.flight_time), each),
    }


def extension_delays(count: int, most: float, seed: int) -> np.ndarray:
    """Return random delays [s] with which front and left legs extend at takeoff, (count, 2).

    They are vectors of length most / 2 to most [s]. A negative delay is one of the back or right legs.
    """
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.5 * most, most, count)
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    return np.stack([size * np.cos(angle), size * np.sin(angle)], axis=1)


def plot_flights(path: Path, logs: Mapping[str, FlightLog], conditions: str) -> None:
    """Plot tilt and base height of all flights over time; logs: one column each, by title."""
    settings = {"figsize": (11, 7), "sharex": True, "sharey": "row", "title": "Flights", "conditions": conditions}
    with figure(path, 2, len(logs), **settings) as axes:
        for column, (name, flights) in zip(axes.T, logs.items(), strict=True):
            time = np.arange(len(flights.tilts)) * flights.step_dt
            column[0].plot(time, np.degrees(np.array(flights.tilts)), linewidth=0.8, alpha=0.5, color="C1")
            column[1].plot(time, np.array(flights.heights), linewidth=0.8, alpha=0.5, color="C0")
            column[0].set(ylabel="tilt [deg]", title=f"{name}: {flights.success.mean():.0%} landed upright")
            column[1].set(xlabel="time [s]", ylabel="base height [m]")


class FlightRun(Run):
    """Evaluation of flights with two skills: a jump, and a policy that turns in flight."""

    flights: FlightLog  # Log of the flights under way

    def __init__(self, args: EvaluationArgs, landing: str, jump: str) -> None:
        """Open the policies, and prepare the output folder.

        args.policy: policy that turns; landing: policy that lands, empty: the default pose in the task `jump`. Raises
        PolicyError or CheckpointError: a policy cannot be used, or its task is another one.
        """
        super().__init__()
        self.turn: Policy = Policy.load(args.policy)
        self.landing: Policy | None = Policy.load(landing) if landing else None
        self.recipes = {"the turning policy": self.turn.recipe()}
        turning = self.recipes["the turning policy"].tested_task(randomize=False)
        if turning.evaluation.kind != "attitude":
            raise PolicyError(f"this needs a policy that turns in flight, {args.policy} is of {turning.name}")
        takes_off = make_task(jump)
        if self.landing is not None:
            self.recipes["the landing policy"] = recipe = self.landing.recipe()
            takes_off = recipe.tested_task(randomize=False)
        if takes_off.evaluation.kind != "height":
            raise PolicyError(f"this needs a jump to heights, got {takes_off.name}")
        self.tasks = takes_off, turning
        self.prepare("flight_attitude", conditions_of(args), args.out, record=args.num_recorded)

    def actor(self, env: Env) -> Callable[[torch.Tensor], torch.Tensor]:
        """Return a function that returns the actions of jump and turning skill, (2, num_envs, 12).

        Its argument is ignored: each policy gets the observations of its own skill.
        """
        scale = env.skills[JUMP].task.action_scale[1]

        def act(obs: torch.Tensor) -> torch.Tensor:
            """Return the actions of jump (policy or fixed takeoff) and turn, (2, num_envs, 12)."""
            jump = None if self.landing is None else self.landing.act(env.skills[JUMP].obs["actor"])
            action = torch.as_tensor(self.flights.action(scale, jump), dtype=torch.float32, device=env.device)
            return torch.stack([action, self.turn.act(env.skills[TURN].obs["actor"])])

        return act

    def env(self, count: int) -> Env:
        """Return an environment of `count` robots with the skills JUMP and TURN."""
        conditions = self.conditions
        tasks, handovers = flight_skills(*(conditions.applied(task) for task in self.tasks))
        robots = {name: recipe.robot for name, recipe in self.recipes.items()}
        settings = conditions.env_settings(shared_robot(robots, conditions))
        env = Env(tasks, count, handovers=handovers, **settings)
        for policy in (self.turn, self.landing):
            if policy is not None:
                policy.to(env.device)
        self.settings["gravity_m_s2"] = env.task.gravity
        self.note_robot(env)
        return env

    def fly(self, env: Env, flights: FlightLog, film: str) -> FlightLog:
        """Run one flight per world into the empty log `flights`, and return the log; film: name of the recording."""
        self.flights = flights
        self.run_episodes(env, flights, film=film)
        return flights


SUMMARY = (
    "landed_upright_rate", "without_turning_landed_upright_rate", "touchdown_tilt_mean_deg",
    "without_turning_touchdown_tilt_mean_deg", "takeoff_tilt_mean_deg", "apex_mean_m",
)  # fmt: skip


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags of the comparison of flights with and without a policy that levels the robot."""

    policy: str = "attitude"  # Name or folder of the policy that turns, a run's folder, or a checkpoint
    landing_policy: str = ""
    """Policy that jumps to heights and lands: name, folder, run or checkpoint (default: the default pose)."""
    jump_task: str = "vertical-jump-mars"  # Task that takes off and lands, unless `landing_policy` is given
    num_flights: int = 60  # Number of flights
    max_leg_delay: float = 15.0  # [ms] Largest delay with which the legs of one end, or side, extend after the others
    takeoff: Literal["open-loop", "policy"] = "open-loop"
    """How robots take off: open loop, with legs that extend unequally, or by the policy that lands."""
    height_range: tuple[float, float] = (2.5, 2.5)
    """[m] Lowest and highest base height commanded to the policy that lands."""

    def __post_init__(self) -> None:
        """Raise InputError for a takeoff by a policy without a policy."""
        super().__post_init__()
        if self.takeoff == "policy" and not self.landing_policy:
            raise InputError("takeoff by a policy needs one: --landing-policy")


def main(args: Args) -> dict:
    """Simulate the same flights with and without the turning policy, plot tilts and heights, and return the metrics."""
    run = FlightRun(args, args.landing_policy, args.jump_task)
    env = run.env(args.num_flights)
    heights = np.linspace(*args.height_range, args.num_flights)
    max_delay = 1.0e-3 * args.max_leg_delay
    late = extension_delays(args.num_flights, max_delay, args.stream_seed) if args.takeoff == "open-loop" else None
    flights = {
        name: run.fly(env, FlightLog(heights, late, turns=name == "turning"), name) for name in ("turning", "without")
    }
    plot_flights(run.folder / "flights.png", flights, run.title)
    settings = {"takeoff": args.takeoff, "landing": args.landing_policy or "default pose"}
    run.settings |= settings | ({} if late is None else {"late_ms": args.max_leg_delay})
    values = flight_metrics(flights["turning"])
    values |= {f"without_turning_{name}": value for name, value in flight_metrics(flights["without"]).items()}
    return run.report(values, {}, SUMMARY)


if __name__ == "__main__":
    run_script(main, Args)

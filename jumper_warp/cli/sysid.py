"""`jumper sysid DATA ...`: parameters of the robot from recorded motions; `excite` plans and records such motions."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from jumper_warp.cli.main import TASK_MODULE_HELP, UsageError, parse
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    from jumper_warp.identification.findings import Identification
    from jumper_warp.identification.motions import Motion
    from jumper_warp.identification.parameters import ParameterSet
    from jumper_warp.identification.residuals import NoiseLevels

HELP = f"""\
usage: jumper sysid DATA ... [flags]
       jumper sysid excite [flags]
       jumper sysid actuator BENCH [flags]

  DATA      recorded motions: npz, csv or parquet files, or folders of them
  excite    plan safe motions that tell much, and record them on a simulated robot
  actuator  limits, friction and latency of one motor from a test bench

The result identified.json is for --robot of jumper train, evaluate and play.
jumper sysid DATA --help shows the flags, and so do excite --help and actuator --help.

{TASK_MODULE_HELP}"""


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the sensors' noise."""

    angle: float = 0.05
    """[deg]"""
    rate: float = 1.0
    """[deg/s]"""
    torque: float = 0.3
    """[N m]"""
    position: float = 5.0
    """[mm] Of the base."""
    orientation: float = 0.5
    """[deg] Of the base."""


@dataclass(frozen=True)
class SysidCfg:
    """Identify parameters of the robot from recorded motions: writes identified.json, report.html and report.json."""

    data: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Files of motions, or folders of them."""
    params: str = "motors,masses,friction,latency,offsets"
    """Groups of parameters, separated by commas."""
    without: str = ""
    """Parameters, or groups of them, that are left as described, separated by commas."""
    mass: float | None = None
    """[kg] What the whole robot weighs on a scale: without it or torques, masses and gains share a factor. Of motions
    that `excite` recorded it tells the mass."""
    mass_deviation: float = 0.02
    """[kg] Of the scale."""
    dt: float | None = None
    """[s] Largest physics step (default: 1/480)."""
    method: Literal["lm", "cma"] = "lm"
    """Staged Levenberg-Marquardt over parallel worlds, or CMA-ES."""
    max_seconds: float = 60.0
    """[s] Time that CMA-ES takes."""
    noise: Noise = Noise()
    """Of the sensors."""
    base: Literal["", "free", "fixed"] = ""
    """Whether the base was free or fixed in all motions (default: as their files say)."""
    gains: Literal["", "jumping", "walking"] = ""
    """Gains that the controllers were set to (default: as the files say, else jumping)."""
    torque_limit: float = 0.0
    """[N m] That the controllers were set to (default: as the files say, else 18)."""
    torque_constant: float = 0.0
    """[N m/A] Torque at the joint per current, for files with currents."""
    out: Path | None = None
    """Folder for the results (default: outputs/sysid/<time>)."""
    device: str | None = None
    """Warp device."""
    threads: int | None = None
    """CPU threads (default: all cores)."""


@dataclass(frozen=True)
class ExciteCfg:
    """Plan safe motions that tell much of the parameters, record them on a simulated robot, and write them as npz."""

    params: str = "motors,masses,friction,latency,offsets"
    """Groups of parameters that the motions are to tell of."""
    candidates: int = 4
    """Random motions of each kind, of which the one that tells most is taken."""
    seconds: float = 1.25
    """[s] Of each motion."""
    sets: int = 1
    """How often the set of two hung chirps, a standing chirp and a small jump is planned."""
    solver: Literal["jumper", "mujoco"] = "jumper"
    """Physics of the robot that is recorded."""
    robot: Path | None = None
    """Overlay of the robot that is recorded (default: as described)."""
    noise: Noise = Noise()
    """Of the sensors."""
    exact: bool = False
    """Record without noise."""
    torque: bool = False
    """Record the motors' torques too."""
    seed: int = 0
    """Of motions and noise."""
    out: Path | None = None
    """Folder for the motions and excite.json (default: outputs/excite/<time>)."""
    threads: int | None = None
    """CPU threads (default: all cores)."""

    def __post_init__(self) -> None:
        """Raises InputError: a number out of range."""
        if not (1 <= self.candidates <= 1000 and 1 <= self.sets <= 100):
            raise InputError(f"candidates and sets must be at least 1, got {self.candidates}, {self.sets}")


@dataclass(frozen=True)
class ActuatorCfg:
    """Fit limits, friction and latency of one motor to data of a test bench: writes actuator.json."""

    bench: Annotated[Path, tyro.conf.Positional]
    """CSV file with columns test, time [s], command [N m], speed [rad/s], torque [N m]; see docs/identification.md."""
    motor: Literal["lateral", "transversal"] = "transversal"
    """Kind of motor, whose described constants are the prior."""
    torque_noise: float = 0.1
    """[N m] Of the bench's torque sensor."""
    out: Path | None = None
    """Folder for the results (default: outputs/actuator/<time>)."""


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Identify, excite or characterise as the arguments say.

    Raises InputError or OSError with one line: data or a flag cannot be used. Exits where tyro does.
    """
    if not args:
        raise UsageError("data comes first: jumper sysid DATA ... [flags]; jumper sysid --help tells more")
    if args[0] in ("-h", "--help"):
        print(HELP)
        raise SystemExit(0)
    if args[0] == "excite":
        excite(parse(ExciteCfg, "sysid excite", args[1:]))
    elif args[0] == "actuator":
        characterise(parse(ActuatorCfg, "sysid actuator", args[1:]))
    else:
        sysid(parse(SysidCfg, "sysid", args))


def parameters_of(groups: str, without: str = "") -> ParameterSet:
    """Return the parameters of groups, without some. Raises InputError for a name that is none."""
    from jumper_warp.identification.parameters import GROUPS, jumper_parameters

    found = jumper_parameters([name for name in groups.split(",") if name])
    left_out = [name for name in without.split(",") if name]
    quantities = {parameter.quantity for parameter in found}
    for name in left_out:
        if name not in (*GROUPS, *found.names, *quantities):
            raise InputError(f"no parameter {name!r:.60} to leave out; there are {', '.join(found.names)}")
    return found.without(left_out)


def noise_of(noise: Noise) -> NoiseLevels:
    """Return noise levels. Raises InputError: one is not positive."""
    from jumper_warp.identification.residuals import NoiseLevels

    return NoiseLevels(**vars(noise))


def motion_files(data: Sequence[Path]) -> list[Path]:
    """Return the files of motions, those of folders by name. Raises InputError: there is none."""
    files = []
    for path in data:
        if path.is_dir():
            files += sorted(file for file in path.iterdir() if file.suffix in (".npz", ".csv", ".parquet"))
        else:
            files.append(path)
    if not files:
        raise InputError(f"no npz, csv or parquet file in {', '.join(map(str, data))}")
    return files


def sysid(cfg: SysidCfg) -> Identification:
    """Identify and write the results; raises as `run`."""
    from rich.console import Console
    from rich.table import Table

    from jumper_warp.identification.identify import identify, weighed
    from jumper_warp.identification.motions import load_motion
    from jumper_warp.identification.report import to_json, write_report
    from jumper_warp.utils.files import write_whole
    from jumper_warp.utils.output import output_dir
    from jumper_warp.utils.runtime import announce

    parameters, noise = parameters_of(cfg.params, cfg.without), noise_of(cfg.noise)
    knowledge = [] if cfg.mass is None else [weighed(cfg.mass, cfg.mass_deviation)]
    given = {name: getattr(cfg, name) for name in ("base", "gains", "torque_limit", "torque_constant")}
    motions = [load_motion(file, **given) for file in motion_files(cfg.data)]
    announce(cfg.device, cfg.threads)
    settings = dict(noise=noise, knowledge=knowledge, dt=cfg.dt, device=cfg.device, threads=cfg.threads)
    if cfg.method == "cma":
        from jumper_warp.identification.evolution import identify_by_evolution

        found = identify_by_evolution(motions, parameters, max_seconds=cfg.max_seconds, **settings)
    else:
        found = identify(motions, parameters, **settings)
    folder = output_dir("sysid", cfg.out)
    names = ", ".join(motion.name for motion in motions)
    found.overlay(f"jumper sysid of {names}").save(folder / "identified.json")
    write_whole(folder / "report.json", (json.dumps(to_json(found), indent=2) + "\n").encode())
    write_report(found, folder)
    table = Table("parameter", "unit", "described", "found", "95 %", box=None)
    for parameter, value, (low, high), sure in zip(
        found.parameters, found.values, found.intervals, found.identified, strict=True
    ):
        row = (parameter.name, parameter.unit, f"{parameter.nominal:.5g}", f"{value:.5g}", f"{low:.5g} … {high:.5g}")
        table.add_row(*row, style=None if sure else "dim")
    Console().print(table)
    told = f"χ² {found.chi2:.4g} (described {found.nominal_chi2:.4g}), {found.seconds:.1f} s"
    print(
        told if found.mismatch == 1.0 else f"{told}; intervals {found.mismatch:.3g} times wider for the model's errors"
    )
    for words in dict.fromkeys(direction.words for direction in found.directions):
        print(f"open: {words}")
    for line in found.doubts:
        print(f"misfit: {line}")
    print(folder / "report.html")
    return found


def excite(cfg: ExciteCfg) -> list[Motion]:
    """Plan, record and write motions; raises as `run`."""
    import numpy as np

    from jumper_warp.identification.excitation import Scorer, choose
    from jumper_warp.identification.identify import total_mass
    from jumper_warp.identification.plans import KINDS
    from jumper_warp.identification.recording import measured, simulate_plan
    from jumper_warp.identification.replay import Replay
    from jumper_warp.robot.overlay import load_overlay
    from jumper_warp.robot.values import RobotValues
    from jumper_warp.utils.files import write_whole
    from jumper_warp.utils.output import output_dir
    from jumper_warp.utils.runtime import announce

    parameters, noise = parameters_of(cfg.params), noise_of(cfg.noise)
    robots = RobotValues.nominal(1) if cfg.robot is None else load_overlay(cfg.robot).robots()
    announce("cpu", cfg.threads)
    scorer = Scorer(parameters, noise, Replay(device="cpu", threads=cfg.threads))
    chosen = choose(scorer, KINDS * cfg.sets, candidates=cfg.candidates, seconds=cfg.seconds, seed=cfg.seed)
    rng = None if cfg.exact else np.random.default_rng([cfg.seed, 1])
    folder, motions = output_dir("excite", cfg.out), []
    for i, (plan, gain) in enumerate(zip(chosen.plans, chosen.gain, strict=True)):
        record = simulate_plan(plan, solver=cfg.solver, robots=robots)
        name = f"{i}_{plan.kind.replace(' ', '_')}"
        motions.append(measured(plan, name, record, robots, rng, noise, torque=cfg.torque))
        motions[-1].save(folder / f"{name}.npz")
        print(f"{name}: {plan.target.shape[0] / 60.0:.2f} s, information up to here {gain:.1f} nat")
    expected = {
        p.name: {"unit": p.unit, "expected_deviation": p.deviation(0.0, float(d)), "of_prior": float(d)}
        for p, d in zip(parameters, chosen.deviations, strict=True)
    }
    mass = float(total_mass(robots)[0])
    told = {"mass_kg": mass, "gain_nat": list(chosen.gain), "refused": list(chosen.refused), "parameters": expected}
    write_whole(folder / "excite.json", (json.dumps(told, indent=2) + "\n").encode())
    sure = int((chosen.deviations < 0.5).sum())
    print(f"{sure} of {len(parameters)} parameters are expected to be identified; motions in {folder}")
    print(f"the recorded robot weighs {mass:.3f} kg: jumper sysid {folder} --mass {mass:.3f}")
    return motions


def characterise(cfg: ActuatorCfg) -> None:
    """Fit one motor and write the result; raises as `run`."""
    from jumper_warp.identification.actuators import characterise_motor, load_bench
    from jumper_warp.utils.files import write_whole
    from jumper_warp.utils.output import output_dir

    found = characterise_motor(load_bench(cfg.bench), cfg.motor, cfg.torque_noise)
    folder = output_dir("actuator", cfg.out)
    write_whole(folder / "actuator.json", (json.dumps(found.to_json(), indent=2) + "\n").encode())
    for name, (value, low, high, unit) in found.rows().items():
        print(f"{name:<16}{value:10.5g} {unit:<6} 95 % {low:.5g} … {high:.5g}")
    print(folder / "actuator.json")

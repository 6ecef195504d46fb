"""`jumper sysid`: identify the robot's parameters from recorded motions, or plan such motions."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from jumper_warp.cli.flags import parse
from jumper_warp.cli.main import INCONSISTENT, TASK_MODULE_HELP, UsageError
from jumper_warp.identification.motions import NoiseLevels, load_motions
from jumper_warp.identification.parameters import jumper_parameters, total_mass, weighed_mass
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, json_bytes, write_atomically

if TYPE_CHECKING:
    from jumper_warp.identification.results import Identification

HELP = f"""\
usage: jumper sysid [fit] DATA ... [flags]
       jumper sysid excite [flags]

  DATA      recorded motions: npz or csv files, folders of them, or
            logs of jumper deploy
  excite    plan safe, informative motions and record them on a simulated robot

The result identified.json is for --robot of jumper train, evaluate and play.
If the fit is not consistent with the data, it is inconsistent.json, and the exit
code is 3.
jumper sysid fit --help and excite --help list the flags.

{TASK_MODULE_HELP}"""


@dataclass(frozen=True)
class SysidCfg:
    """Identify parameters of the robot from recorded motions: writes identified.json, report.json and plots."""

    data: Annotated[tuple[Path, ...], tyro.conf.Positional]  # Files of recorded motions, or folders of them
    params: str = "motors,masses,friction,latency,offsets"  # Groups of parameters to identify, separated by commas
    exclude: str = ""  # Parameters, or groups of them, that keep their described values, separated by commas
    mass: float | None = None
    """[kg] Mass of the whole robot on a scale: without it or torques, masses and gains share a factor. `excite` prints
    the mass of the robot that it records."""
    mass_std: float = 0.02  # [kg] Standard deviation of the scale
    dt: float | None = None  # [s] Largest physics step (default: 1/480)
    noise: NoiseLevels = field(default_factory=NoiseLevels)  # Noise of the sensors, standard deviations
    base: Literal["", "free", "fixed"] = ""
    """Whether the base was free or fixed in all motions (default: as their files say)."""
    gain_preset: Literal["", "jumping", "walking"] = ""
    """Preset of gains that the controllers were set to (default: as the files say, else jumping)."""
    torque_limit: float = 0.0
    """[N m] Torque limit that the controllers were set to (default: as the files say, else 18)."""
    torque_constant: float = 0.0  # [N m/A] Torque at the joint over current, for files with currents
    robot: Path | None = None  # Folder or name of the robot that moved (default: the Jumper)
    out: Path | None = None  # Folder for the results (default: outputs/sysid/<time>)
    json: tyro.conf.FlagCreatePairsOff[bool] = False  # Print report.json in place of a table
    device: str | None = None  # Warp device
    threads: int | None = None  # CPU threads (default: all cores)


@dataclass(frozen=True)
class ExciteCfg:
    """Plan safe, informative motions, record them on a simulated robot, and write them as npz."""

    params: str = "motors,masses,friction,latency,offsets"  # Groups of parameters that the motions are to identify
    num_candidates: int = 4  # Number of random motions of each kind, of which the most informative one is taken
    seconds: float = 1.25  # [s] Length of each motion
    num_sets: int = 1  # Number of sets to plan, each of two hung chirps, a standing chirp and a small jump
    robot: Path | None = None  # Folder, name or overlay of the robot that is recorded (default: the Jumper)
    noise: NoiseLevels = field(default_factory=NoiseLevels)  # Noise of the sensors, standard deviations
    no_noise: tyro.conf.FlagCreatePairsOff[bool] = False  # Record without noise
    record_torque: bool = False  # Also record the motors' torques
    seed: int = 0  # Seed of motions and noise
    out: Path | None = None  # Folder for the motions and excite.json (default: outputs/excite/<time>)
    json: tyro.conf.FlagCreatePairsOff[bool] = False  # Print excite.json in place of a summary
    threads: int | None = None  # CPU threads (default: all cores)

    def __post_init__(self) -> None:
        """Raise InputError if the number of candidates or of sets of motions is out of range."""
        if not (1 <= self.num_candidates <= 1000 and 1 <= self.num_sets <= 100):
            given = f"{self.num_candidates}, {self.num_sets}"
            raise InputError(f"num_candidates must be in 1 to 1000 and num_sets in 1 to 100, got {given}")


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper sysid` with the given arguments: identify the robot, or plan motions.

    modules: unused, as all commands take it. Raises InputError or OSError: data or a flag is invalid.
    """
    if not args:
        raise UsageError("the recorded motions come first: jumper sysid fit DATA ...; see jumper sysid --help")
    if args[0] in ("-h", "--help"):
        print(HELP)
        raise SystemExit(0)
    if args[0] == "excite":
        excite(parse(ExciteCfg, "sysid excite", args[1:]))
    else:
        sysid(parse(SysidCfg, "sysid fit", args[1:] if args[0] == "fit" else args))


def split_names(text: str) -> list[str]:
    """Return the names in a comma-separated text; empty ones are dropped."""
    return [name for name in text.split(",") if name]


def sysid(cfg: SysidCfg) -> None:
    """Identify the robot's parameters from recorded motions, write the report and print the results as a table.

    Exits with code 3 if the fit is not consistent with the data. Raises as `run`.
    """
    from jumper_warp.identification.identify import identify
    from jumper_warp.identification.report import write_results
    from jumper_warp.robot.overlay import LENGTHS, load_overlay
    from jumper_warp.utils.output import output_dir
    from jumper_warp.utils.progress import phase
    from jumper_warp.utils.runtime import configure_device

    cfg.noise.check()
    overlay = load_overlay(cfg.robot)
    if overlay.values.keys() - LENGTHS.keys():
        raise InputError(f"a fit begins at the described values: give the robot's folder, not the overlay {cfg.robot}")
    robot = overlay.description
    parameters = jumper_parameters(split_names(cfg.params), robot).without(split_names(cfg.exclude))
    settings: Json = {name: getattr(cfg, name) for name in ("noise", "dt", "device", "threads")}
    settings["description"] = robot
    settings["prior_measurements"] = [] if cfg.mass is None else [weighed_mass(cfg.mass, cfg.mass_std, robot)]
    recorded_with = {name: getattr(cfg, name) for name in ("base", "torque_limit")} | {"gains": cfg.gain_preset}
    logs = [path for path in cfg.data if (path / "ticks.bin").is_file()]
    files = [path for path in cfg.data if path not in logs]
    motions = load_motions(files, torque_constant=cfg.torque_constant, **recorded_with) if files else []
    if logs:
        from jumper_warp.bench.logs import motions_of_log

        motions += [motion for log in logs for motion in motions_of_log(log, **recorded_with)]
    configure_device(cfg.device, cfg.threads)
    result = identify(motions, parameters, **settings)
    folder = output_dir("sysid", cfg.out)
    with phase("writing the report"):
        write_results(result, folder, f"jumper sysid of {', '.join(motion.name for motion in motions)}")
    if cfg.json:
        print((folder / "report.json").read_text(encoding="utf-8"), end="")
    else:
        print_result(result)
        print(folder)
    if not result.consistent:
        print(f"jumper: not consistent: {result.inconsistency}; robot: {folder / 'inconsistent.json'}", file=sys.stderr)
        raise SystemExit(INCONSISTENT)


def print_result(result: Identification) -> None:
    """Print an identification: parameters with 95 % intervals, χ², starts, undetermined combinations and warnings."""
    from rich.console import Console
    from rich.table import Table

    from jumper_warp.identification.report import starts_line
    from jumper_warp.utils.tables import print_table

    table = Table("parameter", "unit", "description", "identified", "95 % interval", box=None)
    rows = zip(result.parameters, result.values, result.intervals, result.identified, strict=True)
    for parameter, value, (low, high), identified in rows:
        row = (parameter.name, parameter.unit, f"{parameter.nominal:.5g}", f"{value:.5g}", f"{low:.5g} … {high:.5g}")
        table.add_row(*row, style=None if identified else "dim")
    if sys.stdout.isatty():
        Console().print(table)
    else:
        print_table(table)  # rich itself exits with 1 when the reader closes the pipe
    wider = f"; intervals {result.mismatch:.3g} times wider for the model's errors" if result.mismatch != 1.0 else ""
    print(f"χ² {result.chi2:.4g} (robot as described: {result.nominal_chi2:.4g}), {result.effort.seconds:.1f} s{wider}")
    print(starts_line(result))
    for words in dict.fromkeys(direction.words for direction in result.directions):
        print(f"not identified: {words}")
    for line in result.warnings:
        print(f"warning: {line}")


def excite(cfg: ExciteCfg) -> None:
    """Plan motions for identification, record them on a simulated robot, and write npz files and excite.json.

    Raises as `run`.
    """
    import numpy as np

    from jumper_warp.identification.excitation import Scorer, choose, record_motions
    from jumper_warp.identification.recording import KINDS
    from jumper_warp.identification.replay import MotionReplay
    from jumper_warp.robot.overlay import load_overlay
    from jumper_warp.utils.output import output_dir
    from jumper_warp.utils.runtime import configure_device

    cfg.noise.check()
    overlay = load_overlay(cfg.robot)
    robots, robot = overlay.robots(), overlay.description
    parameters = jumper_parameters(split_names(cfg.params), robot)
    configure_device("cpu", cfg.threads)
    replay = MotionReplay(description=robot, device="cpu", threads=cfg.threads)
    scorer = Scorer(parameters, cfg.noise, replay, cfg.record_torque)
    chosen = choose(scorer, KINDS * cfg.num_sets, candidates=cfg.num_candidates, seconds=cfg.seconds, seed=cfg.seed)
    rng = None if cfg.no_noise else np.random.default_rng([cfg.seed, 1])
    folder = output_dir("excite", cfg.out)
    motions = record_motions(
        chosen, folder, scorer.replay, robots=robots, noise=cfg.noise, rng=rng, torque=cfg.record_torque
    )
    mass = float(total_mass(robots, robot)[0])
    content = json_bytes({"mass_kg": mass} | chosen.to_json())
    write_atomically(folder / "excite.json", content)
    if cfg.json:
        print(content.decode(), end="")
        return
    for motion, gain in zip(motions, chosen.gain, strict=True):
        print(f"{motion.name}: {len(motion.time) / 240.0:.2f} s, information up to here {gain:.1f} nat")
    num_identified = int((chosen.std < 0.5).sum())
    print(f"{num_identified} of {len(parameters)} parameters are expected to be identified; motions in {folder}")
    print(f"the recorded robot weighs {mass:.3f} kg: jumper sysid fit {folder} --mass {mass:.3f}")

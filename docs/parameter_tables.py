"""Write the tables of parameters in the documentation from the values in the code.

    python docs/parameter_tables.py

A table stands between the lines `<!-- table: NAME -->` and `<!-- end of table -->` of a page.
`tests/robot/test_parameter_tables.py` checks that the pages are up to date.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path

from jumper_warp import mdp
from jumper_warp.cli.flags import field_docs
from jumper_warp.registry import make_task
from jumper_warp.robot.description import leg_dimensions, load_description
from jumper_warp.robot.model import LIMIT_DAMPING, LIMIT_STIFFNESS, standing_configuration
from jumper_warp.robot.motors import OVERSPEED_END, OVERSPEED_START, LimitsCfg
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.randomization import MEAN_FRICTION, NOMINAL_FRICTION, RandomizationCfg

DOCS = Path(__file__).parent
PAGES = tuple(
    DOCS / page
    for page in (
        "reference/robot_parameters.md",
        "reference/mdp.md",
        "explanation/randomisation.md",
        "explanation/terms_and_kernels.md",
    )
)
BLOCK = re.compile(r"(<!-- table: (\w+) -->\n).*?(\n<!-- end of table -->)", re.DOTALL)
TASKS = (
    "vertical-jump", "horizontal-jump", "horizontal-jump-sighted", "vertical-jump-standing", "horizontal-jump-standing",
    "vertical-jump-mars", "vertical-jump-mars-loose", "horizontal-jump-mars", "horizontal-jump-mars-loose",
    "velocity-flat", "velocity-rough", "velocity-mars", "velocity-trot", "attitude",
)  # fmt: skip
PAPER, CAD, CONFIG = "paper", "CAD export", "authors' configuration"
RANDOMISED = {
    "static_friction": ("static friction of the paws", "1"),
    "dynamic_friction": ("dynamic friction of the paws", "1"),
    "base_mass": ("mass added to the base", "kg"),
    "link_mass": ("factor on mass and inertia, per leg link", "1"),
    "com_shift": ("shift of the base's centre of mass, per axis", "m"),
    "gains": ("factor on kp and kd, per motor", "1"),
    "no_load_speed": ("factor on the no-load speed, per motor", "1"),
    "cutoff_speed": ("factor on the cutoff speed, per motor", "1"),
    "motor_friction": ("Coulomb friction, per motor", "N m"),
    "armature": ("factor on the armature, per motor", "1"),
    "joint_offset": ("offset of the position sensor, per motor", "deg"),
    "latency": ("delay from action to motor", "ms"),
    "observation_latency": ("delay from sensor to policy", "ms"),
    "push_force": ("push on the base, per axis", "N"),
    "push_torque": ("torque on the base, per axis", "N m"),
    "push_interval": ("time between samples of the push", "s"),
}
"""Fields of `RandomizationCfg` in the table: meaning and unit."""
FIELD = re.compile(r"(?:\[(?P<unit>.*?)\] )?(?P<meaning>.*?)(?:, (?P<frame>world|body axes|body to world))?")
"""Comment of a field of `RobotView`: unit in brackets, meaning, frame."""


def number(value: float, digits: int = 5) -> str:
    """Return a number as text with at most `digits` significant digits, and a true minus sign."""
    return re.sub("^-", "−", f"{value:.{digits}g}".replace("e-0", "e-"))


def pair(values: Iterable[float] | None) -> str:
    """Return a range as text, "none" without one."""
    return "none" if values is None else " … ".join(number(value) for value in values)


def degrees(*angles: float) -> str:
    """Return angles [rad] as a range in degrees."""
    return pair(math.degrees(angle) for angle in angles)


def table(header: str, rows: Iterable[tuple[str, ...]]) -> str:
    """Return a Markdown table; header: names of the columns, separated by `|`."""
    columns = [name.strip() for name in header.split("|")]
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def body() -> str:
    """Return masses and lengths."""
    robot = load_description()
    front, back = leg_dimensions(robot, "FL"), leg_dimensions(robot, "BL")
    mass = {link.name.removeprefix("FL_"): number(link.mass) for link in robot.links[:6]}
    heights = {pose: number(standing_configuration(robot, pose)[2], 3) for pose in robot.poses}
    return table(
        "parameter | value | unit | source",
        [
            ("total mass", number(robot.mass), "kg", PAPER),
            ("body, with payload", mass["body"], "kg", "total minus the legs of the CAD export"),
            ("motor housing with three motors", mass["housing"], "kg", CAD),
            ("thigh", mass["outer_thigh"], "kg", CAD),
            ("outer shank", mass["outer_shank"], "kg", CAD),
            ("inner shank, with paw", mass["inner_shank"], "kg", f"{CAD}; paw of 0.02 kg estimated"),
            ("hip x, front and back", f"±{number(front.hip[0])}", "m", CAD),
            ("hip y, front", f"±{number(front.hip[1])}", "m", CAD),
            ("hip y, back", f"±{number(back.hip[1])}", "m", CAD),
            ("outer axis x, from the hip", f"±{number(front.outer_x)}", "m", CAD),
            ("inner axis x, from the hip", f"±{number(front.inner_x)}", "m", CAD),
            ("plane of the thighs, y from the hip", f"±{number(front.plane_y)}", "m", CAD),
            ("knees and ankle, y from the plane of the thighs", f"±{number(front.knee_y)}", "m", CAD),
            ("thigh length", number(front.thigh), "m", PAPER),
            ("shank length", number(front.shank), "m", PAPER),
            ("paw radius", number(front.paw_radius), "m", CAD),
            ("base height, default pose (0°, 45°)", heights["default"], "m", "computed"),
            ("base height, nominal pose (0°, 57°)", heights["nominal"], "m", "computed; paper 0.35"),
        ],
    )


def motors() -> str:
    """Return the constants of both motor types, at the joint."""
    lateral, transversal = load_description().motors[:2]

    def row(name: str, unit: str, source: str, value: Callable) -> tuple[str, ...]:
        return name, number(value(lateral), 4), number(value(transversal), 4), unit, source

    fade = f"{number(math.degrees(OVERSPEED_START))} … {number(math.degrees(OVERSPEED_END))}"
    return table(
        f"parameter | lateral, {lateral.type} | transversal, {transversal.type} | unit | source",
        [
            row("gear ratio", "1", "type name", lambda m: m.gear_ratio),
            row("rotor inertia", "kg m²", CONFIG, lambda m: m.rotor_inertia),
            row("armature: rotor inertia × ratio²", "kg m²", "computed", lambda m: m.armature),
            row("peak torque", "N m", PAPER, lambda m: m.peak_torque),
            row("cutoff speed: full torque up to this speed", "rad/s", CONFIG, lambda m: m.cutoff_speed),
            row("no-load speed: no torque from this speed on", "rad/s", CONFIG, lambda m: m.no_load_speed),
            row("Coulomb friction", "N m", "inside the paper's range", lambda m: m.coulomb_friction),
            row("kp", "N m/rad", CONFIG, lambda m: m.jumping.kp),
            row("kd, jumping", "N m s/rad", CONFIG, lambda m: m.jumping.kd),
            row("kd, walking", "N m s/rad", CONFIG, lambda m: m.walking.kd),
            ("over-speed protection fades the torque", fade, fade, "deg/s", CONFIG),
        ],
    )


def passive() -> str:
    """Return hard stops, knee damping and paw friction."""
    robot = load_description()
    lateral, outer = robot.joints[:2]
    return table(
        "parameter | value | unit | source",
        [
            ("stops, lateral", degrees(lateral.lower, lateral.upper), "deg", f"{CONFIG}, limited by the shell"),
            ("stops, transversal", degrees(outer.lower, outer.upper), "deg", CONFIG),
            ("stops, sum of outer and inner angle", degrees(*robot.transversal_sum), "deg", CONFIG),
            ("stiffness of the stops", number(LIMIT_STIFFNESS), "N m/rad", "numerical"),
            ("damping of the stops", number(LIMIT_DAMPING), "N m s/rad", "numerical"),
            ("knee damping", number(robot.knee_damping), "N m s/rad", CONFIG),
            ("largest torque of the knee damping", number(robot.knee_damping_limit), "N m", CONFIG),
            ("paw friction, Python class `Simulation`", number(NOMINAL_FRICTION), "1", "chosen"),
            ("paw friction, nominal evaluation", number(MEAN_FRICTION), "1", "middle of the paper's range"),
        ],
    )


def grouped(row: Callable[[TaskCfg], tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return one row for each group of tasks with equal cells, names of the tasks first."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for name in TASKS:
        groups.setdefault(row(make_task(name)), []).append(f"`{name}`")
    return [(", ".join(names), *cells) for cells, names in groups.items()]


def tasks() -> str:
    """Return torque limits, gains and action scales by task."""

    def row(task: TaskCfg) -> tuple[str, ...]:
        kinds = task.motors.lateral, task.motors.transversal
        cells = ([kind.saturation for kind in kinds], [kind.kp for kind in kinds], [kind.kd for kind in kinds],
                 task.action_scale)  # fmt: skip
        return *(" / ".join(number(value) for value in values) for values in cells), number(task.gravity)

    header = "task | torque limit [N m] | kp [N m/rad] | kd [N m s/rad] | action scale [deg] | gravity [m/s²]"
    return table(header, grouped(row))


def limits(cfg: LimitsCfg) -> str:
    """Return a range [deg], with the widths of its hard zones in brackets."""
    zones = f" ({number(cfg.lower_zone)}, {number(cfg.upper_zone)})" if cfg.lower_zone or cfg.upper_zone else ""
    return pair((cfg.lower, cfg.upper)) + zones


def filters() -> str:
    """Return the command filter by task."""

    def row(task: TaskCfg) -> tuple[str, ...]:
        cfg = task.command_filter
        ranges = (limits(angle) for angle in (cfg.lateral, cfg.transversal, cfg.sum))
        return *ranges, number(1000.0 * cfg.horizon, 3), number(cfg.speed_floor)

    header = "task | lateral [deg] | transversal [deg] | outer + inner [deg] | horizon [ms] | speed floor [deg/s]"
    return table(header, grouped(row))


def randomisation() -> str:
    """Return the ranges of domain randomisation for jumping and walking."""
    jumping, walking = RandomizationCfg(), RandomizationCfg.walking()
    return table(
        "parameter | setting | jumping tasks | walking tasks | unit",
        [
            (meaning, f"`{field}`", pair(getattr(jumping, field)), pair(getattr(walking, field)), unit)
            for field, (meaning, unit) in RANDOMISED.items()
        ],
    )


def commands() -> str:
    """Return the numbers of a command by task."""
    return table("task | numbers of a row", grouped(lambda task: (str(task.command),)))


def robot_view() -> str:
    """Return the fields of `RobotView`, in the order of the struct."""

    def row(name: str, comment: str) -> tuple[str, ...]:
        kind = mdp.RobotView.vars[name].type
        shape = " × ".join(str(size) for size in getattr(kind, "_shape_", ())) or "1"
        field = FIELD.fullmatch(comment)
        assert field is not None
        return f"`{name}`", shape, field["unit"] or "1", field["frame"] or "", field["meaning"]

    docs = field_docs(mdp.RobotView.cls)
    return table("field | shape | unit | frame | meaning", [row(name, docs[name]) for name in mdp.RobotView.vars])


TABLES = {each.__name__: each for each in (body, motors, passive, tasks, filters, randomisation, commands, robot_view)}


def updated(text: str) -> str:
    """Return a page's text with the tables replaced by those of the code."""
    return BLOCK.sub(lambda block: block[1] + TABLES[block[2]]() + block[3], text)


def main() -> None:
    """Rewrite the tables of all pages."""
    for page in PAGES:
        page.write_text(updated(page.read_text()))


if __name__ == "__main__":
    main()

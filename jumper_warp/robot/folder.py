"""Robot tables: the file `robot.json` of a robot's folder, with a value, a unit and a source for every quantity.

A table describes a quadruped with five-bar legs by lengths, masses, motors and stops. Vectors and inertias are those of
a left front leg; the others are mirrored. Lengths of a leg: `hip` (ahead of and beside the middle of the body, and
above it), axes of the thighs `outer_axis`, `inner_axis` from the hip away from the middle, `plane` and `knee_offset`
outward. `paw_offset` is the distance from ankle to paw along the inner shank. A quantity in a section FL, FR, BL or BR
replaces that of `front` or `back`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import astuple, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from jumper_warp.robot.description import RAD_PER_S_PER_RPM, load_description
from jumper_warp.robot.legs import leg_dimensions
from jumper_warp.robot.parts import (
    LEGS,
    MOTOR_JOINTS,
    Gains,
    Hull,
    Joint,
    Link,
    Loop,
    Motor,
    RobotDescription,
    Shape,
    make_read_only,
)
from jumper_warp.robot.urdf import UrdfReader, quat_from_rpy
from jumper_warp.utils.checks import FLOAT32_MAX
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, read_json, write_atomically

SCHEMA = "jumper-warp robot 1"
FILE = "robot.json"
LINKS = ("housing", "outer_thigh", "outer_shank", "inner_thigh", "inner_shank")
BODY = {"mass": "kg", "com": "m", "inertia": "kg m^2", "shell": "m"}
LEG = (
    dict.fromkeys(("hip", "outer_axis", "inner_axis", "plane", "knee_offset", "thigh", "outer_shank", "inner_shank",
                   "paw_offset", "paw_radius"), "m")
    | {f"{link}_{name}": BODY[name] for link in LINKS for name in ("mass", "com", "inertia")}
    | {"lateral_motor": "", "transversal_motor": "", "lateral_stops": "deg", "transversal_stops": "deg"}
)  # fmt: skip
COMMON = {
    "thigh_radius": "m", "shank_radius": "m", "housing_radius": "m", "housing_length": "m",
    "knee_damping": "N m s/rad", "knee_damping_limit": "N m", "transversal_sum_stops": "deg", "default_pose": "deg",
    "nominal_pose": "deg", "spring_stiffness": "N/m", "spring_length": "m",
}  # fmt: skip
MOTOR = {
    "gear_ratio": "", "rotor_inertia": "kg m^2", "peak_torque": "N m", "cutoff_speed": "rpm", "no_load_speed": "rpm",
    "coulomb_friction": "N m", "kp_jumping": "N m/rad", "kd_jumping": "N m s/rad", "kp_walking": "N m/rad",
    "kd_walking": "N m s/rad",
}  # fmt: skip
"""Unit of each quantity by section of a table: of the body, of a leg, of all legs, and of a type of motor."""
SECTIONS = {"body": BODY, "legs": COMMON, "front": LEG, "back": LEG}
SHELL = np.array([0.686, 0.398, 0.148])  # [m] Length, width and height of the Jumper's shell, for whose factor of 1
LOCKED = Motor("locked", 1.0, 1.0e5, 1.0, 1.0, 2.0, 1.0e-3, Gains(0.0, 0.0), Gains(0.0, 0.0))
"""Motor of a leg without lateral axis (`"lateral_motor": "locked"`): its inertia keeps the axis at its angle."""
ELSEWHERE = "this package simulates four five-bar legs; use Newton or mjlab for serial legs and other numbers of legs"


def read_robot(path: Path) -> Json:
    """Return the table of a robot's folder, or of its file. Raises InputError: it is no valid table."""
    file = path / FILE if path.is_dir() else path
    table = read_json(file, "robot table, as jumper robot new writes it")
    try:
        robot_of(table)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    return table


def write_robot(folder: Path, table: Json) -> Path:
    """Write a robot's table to a folder, one quantity a line, and return the file's path. Raises OSError."""
    text = json.dumps(table, indent=2)
    text = re.sub(r'\{\s+"value".*?\n +\}', lambda row: " ".join(row.group().split()), text, flags=re.DOTALL)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / FILE, f"{text}\n".encode())
    return folder / FILE


def table_of(robot: RobotDescription, source: str) -> Json:
    """Return the table of a description whose right legs mirror the left ones; source: of all values, free text."""

    def rows(units: Mapping[str, str], values: Mapping[str, Any]) -> Json:
        return {name: {"value": values[name], "unit": unit, "source": source} for name, unit in units.items()}

    body, hull = robot.links[0], robot.hull
    ends = {name: rows(LEG, _leg_values(robot, leg)) for name, leg in (("front", "FL"), ("back", "BL"))}
    poses = {f"{name}_pose": [math.degrees(angle) for angle in robot.poses[name]] for name in ("default", "nominal")}
    common = {name: getattr(hull, name, None) for name in COMMON} | poses | {
        "knee_damping": robot.knee_damping, "knee_damping_limit": robot.knee_damping_limit,
        "transversal_sum_stops": [math.degrees(end) for end in robot.transversal_sum],
        "spring_stiffness": robot.spring[0], "spring_length": robot.spring[1],
    }  # fmt: skip
    motors = {}
    for motor in robot.motors:
        gains = {
            f"{k}_{name}": getattr(getattr(motor, name), k) for k in ("kp", "kd") for name in ("jumping", "walking")
        }
        speeds = {name: getattr(motor, name) / RAD_PER_S_PER_RPM for name in ("cutoff_speed", "no_load_speed")}
        if motor != LOCKED:
            motors[motor.type] = rows(MOTOR, vars(motor) | speeds | gains)
    shell = [round(float(x), 6) for x in SHELL * hull.shell]
    inertia = {"mass": body.mass, "com": body.com.tolist(), "inertia": _moments(body.inertia), "shell": shell}
    return {"schema": SCHEMA, "name": robot.name, "body": rows(BODY, inertia), "legs": rows(COMMON, common), **ends,
            "motors": motors}  # fmt: skip


def stretch(section: Json, quantity: str, length: float) -> None:
    """Set a thigh's or shank's length [m] in a leg's section of a table, in place; the link's mass stays the same.

    Its centre of mass moves along the link, and its inertia grows, as those of a link stretched evenly.
    """
    factor = length / section[quantity]["value"]
    section[quantity] = {**section[quantity], "value": length}
    for link in ("outer_thigh", "inner_thigh") if quantity == "thigh" else (quantity,):
        for name, scale in (("com", [1.0, 1.0, factor]), ("inertia", [factor**2, factor**2, 1.0, 1.0, factor, factor])):
            row = section[f"{link}_{name}"]
            section[f"{link}_{name}"] = {**row, "value": (np.array(row["value"]) * scale).tolist()}


def _moments(inertia: np.ndarray) -> list[float]:
    """Return an inertia tensor as the list xx, yy, zz, xy, xz, yz."""
    return inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist()


def _leg_values(robot: RobotDescription, leg: str) -> Json:
    """Return the values of `LEG` for a left leg of a description."""
    size = leg_dimensions(robot, leg)
    mirror = np.array([size.front, 1.0, 1.0])
    flip = np.array([1.0, 1.0, 1.0, size.front, size.front, 1.0])  # of xx, yy, zz, xy, xz, yz
    values: Json = {"hip": (mirror * size.hip).tolist(), "outer_axis": abs(size.outer_x), "plane": size.plane_y,
                    "inner_axis": abs(size.inner_x), "knee_offset": size.knee_y, "thigh": size.thigh,
                    "outer_shank": size.outer_shank, "inner_shank": size.shank, "paw_offset": size.paw_offset,
                    "paw_radius": size.paw_radius}  # fmt: skip
    for name in LINKS:
        link = robot.link(f"{leg}_{name}")
        inertia = (flip * _moments(link.inertia) + 0.0).tolist()
        values |= {f"{name}_mass": link.mass, f"{name}_com": (mirror * link.com + 0.0).tolist(),
                   f"{name}_inertia": inertia}  # fmt: skip
    for index, kind in enumerate(("lateral", "transversal")):
        joint = robot.joint(f"{leg}_{('lateral', 'outer')[index]}")
        values[f"{kind}_motor"] = robot.motors[3 * LEGS.index(leg) + index].type
        values[f"{kind}_stops"] = [round(math.degrees(end), 4) for end in (joint.lower, joint.upper)]
    return values


def robot_of(table: Json) -> RobotDescription:
    """Return the description of the robot in a table. Raises InputError: the table is invalid."""
    if not isinstance(table, dict) or table.get("schema") != SCHEMA:
        raise InputError(f"not a robot table: expected an object with schema {SCHEMA!r}")
    if unknown := set(table) - {"schema", "name", "about", "motors", *SECTIONS, *LEGS}:
        raise InputError(f"unknown section {min(unknown)!r:.60}: {ELSEWHERE}")
    for name in ("motors", *LEGS):
        if not isinstance(table.get(name, {}), dict):
            raise InputError(f"section {name!r} must be an object, got {table[name]!r:.40}")
    read = {name: _values(name, table.get(name), units) for name, units in SECTIONS.items()}
    motors = {name: _motor(name, rows) for name, rows in table.get("motors", {}).items()} | {"locked": LOCKED}
    body, common = read["body"], read["legs"]
    hull = Hull(**{name: common[name] for name in vars(Hull()) if name != "shell"}, shell=tuple(body["shell"] / SHELL))
    jumper = load_description()
    links = {"body": replace(jumper.links[0], mass=body["mass"], com=body["com"], inertia=_tensor(body["inertia"]),
                             visuals=_body_shapes(body["shell"]), collisions=())}  # fmt: skip
    joints: dict[str, Joint] = {}
    loops, of_leg = [], []
    for leg in LEGS:
        own = {name: LEG[name] for name in table.get(leg, {}) if name in LEG}
        values = read["front" if leg[0] == "F" else "back"] | _values(leg, table.get(leg, {}), own)
        for kind in ("lateral", "transversal"):
            if values[f"{kind}_motor"] not in motors:
                raise InputError(f"{leg} {kind}_motor: no motor {values[f'{kind}_motor']!r:.60} in section 'motors'")
        lateral, transversal = (motors[values[f"{kind}_motor"]] for kind in ("lateral", "transversal"))
        of_leg += [lateral, transversal, transversal]
        links |= _leg_links(jumper, leg, values, hull)
        joints |= _leg_joints(jumper, leg, values, (lateral, transversal))
        loops.append(_leg_loop(jumper, leg, values))
    for motor, one in zip(of_leg, 4 * of_leg[:3], strict=True):  # relative tolerance: gains in files are rounded
        pairs = ((motor.walking, one.jumping), (motor.jumping, one.walking))
        if not np.allclose(*(np.multiply(astuple(a), astuple(b)) for a, b in pairs), rtol=1.0e-3, atol=0.0):
            raise InputError(f"motors {motor.type}: ratios to the gains of {one.type} differ in walking and jumping")
    robot = replace(
        jumper,
        name=str(table.get("name", "robot")),
        links=tuple(links[link.name] for link in jumper.links),
        joints=tuple(joints[joint.name] for joint in jumper.joints),
        loops=tuple(loops),
        motors=tuple(of_leg),
        knee_damping=common["knee_damping"],
        knee_damping_limit=common["knee_damping_limit"],
        transversal_sum=tuple(np.radians(common["transversal_sum_stops"]).tolist()),
        poses=MappingProxyType({name: tuple(np.radians(common[f"{name}_pose"]).tolist()) for name in jumper.poses}),
        spring=(common["spring_stiffness"], common["spring_length"]),
        hull=hull,
        table=table,
    )
    make_read_only(robot)
    for link in robot.links:
        if np.linalg.eigvalsh(link.inertia)[0] <= 0.0:
            raise InputError(f"{link.name}: the principal moments of its inertia must be positive")
    for leg in LEGS:
        leg_dimensions(robot, leg).depth(*robot.poses["default"])
    return robot


SIZES = {"rotor_inertia": 1, "com": 3, "inertia": 6, "shell": 3, "hip": 3, "stops": 2, "pose": 2}
"""Number of values of a quantity, by the end of its name; others have one."""
POSITIVE = ("mass", "peak_torque", "no_load_speed", "gear_ratio")  # Ends of names of quantities that cannot be 0


def _values(where: str, section: Any, units: Mapping[str, str]) -> Json:
    """Return the values in a section of a table, by quantity, in the table's units (degrees, rpm).

    units: of all quantities in the section. Several numbers become an array, the name of a motor stays text. where:
    the section's name, for messages. Raises InputError: a value is missing, or of another kind or unit.
    """
    if not isinstance(section, dict):
        raise InputError(f"section {where!r} is missing: {ELSEWHERE}")
    if unknown := set(section) - set(units):
        raise InputError(f"{where}: unknown quantity {min(unknown)!r:.60}; expected {', '.join(units)}")
    values = {}
    for name, unit in units.items():
        row = section.get(name)
        if not isinstance(row, dict) or "value" not in row:
            hint = f"; {ELSEWHERE}" if name in LEG else ""
            raise InputError(f"{where}: {name} needs an object with value, unit and source, got {row!r:.40}{hint}")
        value, found = row["value"], row.get("unit", unit)
        if found != unit:
            raise InputError(f"{where}: the unit of {name} is {unit or 'none'}, got {found!r:.40}")
        size = SIZES.get(name, SIZES.get(name.split("_")[-1], 1))
        if name.endswith("_motor"):
            fits = isinstance(value, str)
        else:
            numbers = [value] if size == 1 else value
            fits = isinstance(numbers, Sequence) and len(numbers) == size and all(map(is_finite, numbers))
            value = np.array(value, dtype=float) if fits and size > 1 else value
        if fits and size == 1 and not isinstance(value, str):
            fits = value > 0.0 if name.endswith(POSITIVE) else value >= 0.0
        if not fits:
            sign = "positive" if name.endswith(POSITIVE) else "not negative if a single one"
            numbers = f"{size} finite number{'s' * (size > 1)}, {sign}"
            wanted = "the name of a motor" if name.endswith("_motor") else numbers
            raise InputError(f"{where}: {name} must be {wanted}, got {row['value']!r:.60}")
        values[name] = value
    return values


def is_finite(value: Any) -> bool:
    """Return whether a value is a number, no bool, and finite in float32."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= FLOAT32_MAX


def _motor(name: str, rows: Any) -> Motor:
    """Return the motor of a type from its rows in a table."""
    value = _values(f"motors {name}", rows, MOTOR)
    gains: Any = {of: Gains(value.pop(f"kp_{of}"), value.pop(f"kd_{of}")) for of in ("jumping", "walking")}
    speeds = {key: value.pop(key) * RAD_PER_S_PER_RPM for key in ("cutoff_speed", "no_load_speed")}
    return Motor(name, **value, **speeds, **gains)


def _tensor(moments: np.ndarray) -> np.ndarray:
    """Return the inertia tensor with moments xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = moments
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _sides(leg: str) -> np.ndarray:
    """Return the signs of x, y and z that mirror the left front leg to a leg."""
    return np.array([1.0 if leg[0] == "F" else -1.0, 1.0 if leg[1] == "L" else -1.0, 1.0])


def _leg_links(jumper: RobotDescription, leg: str, values: Json, hull: Hull) -> dict[str, Link]:
    """Return the five links of a leg by name."""
    mirror = _sides(leg)
    ends = {"outer_thigh": values["thigh"], "inner_thigh": values["thigh"], "outer_shank": values["outer_shank"],
            "inner_shank": values["inner_shank"] + values["paw_offset"]}  # fmt: skip
    links = {}
    for name in LINKS:
        radius = hull.thigh_radius if name.endswith("thigh") else hull.shank_radius
        if name == "housing":
            shapes = capsule(
                np.array([mirror[0] * hull.housing_length, 0.0, 0.0]), hull.housing_radius, (0.2, 0.21, 0.24)
            )
        else:
            shapes = capsule(np.array([0.0, 0.0, -ends[name]]), radius, (0.62, 0.64, 0.67))
        paws = ()
        if name == "inner_shank":
            place = np.array([0.0, 0.0, -ends[name]])
            paw = Shape("sphere", (values["paw_radius"],), place, np.array([0.0, 0.0, 0.0, 1.0]))
            paws = (paw,)
            shapes = (*shapes, replace(paw, color=(0.06, 0.06, 0.06)))
        inertia = _tensor(values[f"{name}_inertia"]) * np.outer(mirror, mirror)
        links[f"{leg}_{name}"] = replace(
            jumper.link(f"{leg}_{name}"), mass=values[f"{name}_mass"], com=mirror * values[f"{name}_com"],
            inertia=inertia, visuals=shapes, collisions=paws,
        )  # fmt: skip
    return links


def _leg_joints(jumper: RobotDescription, leg: str, values: Json, motors: tuple[Motor, Motor]) -> dict[str, Joint]:
    """Return the five hinges of a leg by name; motors: lateral and transversal."""
    mirror = _sides(leg)
    knee = (0.0, values["knee_offset"], -values["thigh"])
    origins = {"lateral": values["hip"], "outer": (values["outer_axis"], values["plane"], 0.0), "outer_knee": knee,
               "inner": (values["inner_axis"], values["plane"], 0.0), "inner_knee": knee}  # fmt: skip
    joints = {}
    for name, origin in origins.items():
        joint = replace(jumper.joint(f"{leg}_{name}"), origin=mirror * origin, lower=-math.pi, upper=math.pi)
        if not name.endswith("knee"):
            kind, motor = ("lateral", motors[0]) if name == "lateral" else ("transversal", motors[1])
            lower, upper = np.radians(values[f"{kind}_stops"]).tolist()
            joint = replace(joint, lower=lower, upper=upper, effort=motor.peak_torque, velocity=motor.no_load_speed)
        joints[joint.name] = joint
    return joints


def _leg_loop(jumper: RobotDescription, leg: str, values: Json) -> Loop:
    """Return the loop of a leg, which joins the ends of its shanks."""
    inner, outer = (np.array([0.0, 0.0, -values[f"{bar}_shank"]]) for bar in ("inner", "outer"))
    return replace(jumper.loops[LEGS.index(leg)], parent_anchor=inner, child_anchor=outer)


def capsule(end: np.ndarray, radius: float, color: tuple[float, float, float]) -> tuple[Shape, ...]:
    """Return the shapes of a capsule from a link's origin to `end` [m] along x or z: a cylinder and two spheres."""
    along_x = abs(end[0]) > abs(end[2])
    turn = quat_from_rpy(0.0, 0.5 * math.pi, 0.0) if along_x else quat_from_rpy(0.0, 0.0, 0.0)
    straight = quat_from_rpy(0.0, 0.0, 0.0)
    tube = Shape("cylinder", (radius, float(np.linalg.norm(end))), 0.5 * end, turn, color)
    return (tube, *(Shape("sphere", (radius,), place, straight, color) for place in (np.zeros(3), end)))


def _body_shapes(size: np.ndarray) -> tuple[Shape, ...]:
    """Return the box that shows a body's shell; size [m]: length, width of the widest motors, height."""
    straight = quat_from_rpy(0.0, 0.0, 0.0)
    trunk = np.array([1.0, 0.5, 1.0]) * size
    return (Shape("box", tuple(trunk.tolist()), np.array([0.0, 0.0, 0.17 * size[2]]), straight, (0.3, 0.42, 0.55)),)


def read_urdf(path: Path) -> RobotDescription:
    """Return the robot of a URDF, with `loop_closures.yaml` beside it, as `jumper export robot` writes them.

    Links and joints have the Jumper's names; other constants of the motors, stops of a sum and poses are the
    Jumper's. Back motors have a type of their own if their torque or speed differs from that of the front ones.
    Raises InputError: it has other legs.
    """
    jumper = load_description()
    reader = UrdfReader(path)
    links, joints = reader.links(), reader.joints()
    file = path.parent / "loop_closures.yaml"
    points = re.findall(r"^ +points: (.*)$", file.read_text(encoding="utf-8"), re.MULTILINE) if file.is_file() else []
    same = {link.name for link in links} == {link.name for link in jumper.links}
    if not same or {joint.name for joint in joints} != {joint.name for joint in jumper.joints} or len(points) != 4:
        raise InputError(f"{path}: found {len(joints)} hinges and {len(points)} loops: {ELSEWHERE}")
    loops = []
    for loop, text in zip(jumper.loops, points, strict=True):
        parent, child = (np.array(anchor, dtype=float) for anchor in json.loads(text))
        loops.append(replace(loop, parent_anchor=parent, child_anchor=child))
    ends = {joint.name: {"peak_torque": joint.effort, "no_load_speed": joint.velocity} for joint in joints}
    motors = tuple(
        LOCKED if name.endswith("lateral") and ends[name]["no_load_speed"] == LOCKED.no_load_speed
        else replace(motor, type=motor.type + " back" * (ends[name] != ends[f"F{name[1:]}"]), **ends[name])
        for name, motor in zip(MOTOR_JOINTS, jumper.motors, strict=True)
    )  # fmt: skip
    return replace(jumper, name=path.stem, links=links, joints=joints, loops=tuple(loops), motors=motors)

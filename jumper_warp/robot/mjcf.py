"""Export of the robot as an MJCF model of MuJoCo: closed loops, stops, position servos, ground and default pose.

MJCF describes a tree of bodies: each leg's loop is cut at the ankle and closed by an equality constraint. Quaternions
are wxyz in MJCF and xyzw in this project; sizes of shapes are halved.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any
from xml.etree.ElementTree import Comment, Element, SubElement, indent, tostring

from jumper_warp.robot import model
from jumper_warp.robot.description import LEGS, MOTOR_JOINTS, RobotDescription
from jumper_warp.robot.parts import Link, Shape, mesh_files
from jumper_warp.robot.values import RobotValues, described

STIFFEST = 0.001  # [s] Time constant of loops and stops, which MuJoCo raises to two of its time steps
GROUND_EDGE = 20.0  # [m] Half the edge of the ground that viewers draw; the plane itself has no end
ABOUT = """
  The robot {name}, written by the command `jumper export robot`. SI units, angles in radians, quaternions wxyz.
  data.ctrl: targets of the 12 motors [rad], legs FL, FR, BL, BR, each lateral, outer, inner. The other 8 actuators
  are the dampers of the passive knees: leave their control at 0. Keyframe "default" is the standing pose.
  At qpos = 0 the loops are open: start from the keyframe.
"""


def mjcf(description: RobotDescription, values: RobotValues | None = None) -> str:
    """Return an MJCF model, as text, of a robot that stands on a plane; its meshes are files in the folder meshes/.

    values: of the robot (N = 1), as `RobotOverlay.robots()` returns them; by default the described ones. MJCF has no
    place for their sensor offset, latency and the motors' speeds. Raises KeyError without a default pose.
    """
    values = RobotValues.nominal(1, description) if values is None else values
    robot = described(values, description)
    root = Element("mujoco", model="jumper")
    root.append(Comment(ABOUT.format(name=robot.name)))
    add(root, "compiler", angle="radian", meshdir="meshes", autolimits="true")
    # Euler applies the motors' damping explicitly, as this project does on SolverMuJoCo
    add(root, "option", timestep=model.PHYSICS_DT, integrator="Euler", cone="pyramidal")
    add(root, "statistic", center=(0, 0, 0.3), extent=0.8)  # [m], for viewers
    _add_defaults(root, values.paw_friction[0, 0])
    _add_assets(root, robot)
    _add_world(root, robot)
    _add_tendons(root, robot, values)
    equality = add(root, "equality")
    for loop in robot.loops:
        add(equality, "connect", name=loop.name, site1=f"{loop.name}_parent", site2=f"{loop.name}_child",
            solref=(STIFFEST, 1), solimp=model.LOOP_IMPEDANCE)  # fmt: skip
    _add_actuators(root, robot)
    _add_keyframe(root, robot)
    indent(root)
    return f"{tostring(root, encoding='unicode')}\n"


def add(parent: Element, tag: str, **attributes: Any) -> Element:
    """Add a child element with a tag and attributes to an XML element, and return the child.

    Numbers and lists of numbers become text, attributes of None are left out.
    """
    text = {name.rstrip("_"): _text(value) for name, value in attributes.items() if value is not None}
    return SubElement(parent, tag, text)


def _text(value: Any) -> str:
    """Return the value of an XML attribute as text, numbers with twelve digits."""
    if isinstance(value, str):
        return value
    if isinstance(value, Iterable):
        return " ".join(map(_text, value))
    return f"{float(value) + 0.0:.12g}"


def _add_defaults(root: Element, paw_friction: float) -> None:
    """Add the default classes "visual" and "paw" and the softness of stops to the MJCF model; paw_friction: [1]."""
    defaults = add(root, "default")
    add(defaults, "joint", solreflimit=(STIFFEST, 1))
    add(add(defaults, "default", class_="visual"), "geom", contype="0", conaffinity="0", group="2", mass=0)
    paw = add(defaults, "default", class_="paw")
    # with priority, the paw's friction and softness hold on every ground, and paws do not collide with each other
    ratio = 0.5 * model.CONTACT_DAMPING / model.CONTACT_STIFFNESS**0.5
    softness = {"solref": (2.0 / model.CONTACT_DAMPING, ratio), "solimp": model.CONTACT_IMPEDANCE}
    add(paw, "geom", contype="1", conaffinity="0", priority="1", condim="3", group="3",
        friction=(paw_friction, 0.005, 0.0001), **softness)  # fmt: skip


def _add_assets(root: Element, robot: RobotDescription) -> None:
    """Add the meshes, each once and named like its file, and the ground's material to the MJCF model."""
    assets = add(root, "asset")
    for file in sorted(mesh_files(robot)):
        add(assets, "mesh", name=file.stem, file=file.name)
    darker = [0.8 * value for value in model.GROUND_COLOR]
    add(assets, "texture", name="ground", type="2d", builtin="checker", width="256", height="256",
        rgb1=model.GROUND_COLOR, rgb2=darker)  # fmt: skip
    add(assets, "material", name="ground", texture="ground", texrepeat=(2, 2), texuniform="true")


def _add_world(root: Element, robot: RobotDescription) -> None:
    """Add light, ground and the tree of bodies with their joints, shapes and sites to the MJCF model."""
    world = add(root, "worldbody")
    add(world, "light", pos=(0, 0, 3), dir=(0, 0, -1), directional="true")
    add(world, "geom", name="ground", type="plane", size=(GROUND_EDGE, GROUND_EDGE, 0.1), contype="0", conaffinity="1",
        material="ground")  # fmt: skip
    motors = dict(zip(MOTOR_JOINTS, robot.motors, strict=True))
    links = {link.name: link for link in robot.links}
    height = float(model.standing_configuration(robot)[2])
    bodies = {"body": add(world, "body", name="body", pos=(0, 0, height))}
    add(bodies["body"], "freejoint", name="base")
    _add_shapes(bodies["body"], links["body"])
    for joint in robot.joints:
        body = bodies[joint.child] = add(bodies[joint.parent], "body", name=joint.child, pos=joint.origin)
        motor = motors.get(joint.name)
        losses = {"armature": motor.armature, "frictionloss": motor.coulomb_friction} if motor else {}
        add(body, "joint", name=joint.name, axis=joint.axis, range=(joint.lower, joint.upper), **losses)
        _add_shapes(body, links[joint.child])
        if joint.name.endswith("knee"):
            add(body, "site", name=joint.name)
    for loop in robot.loops:
        add(bodies[loop.parent], "site", name=f"{loop.name}_parent", pos=loop.parent_anchor)
        add(bodies[loop.child], "site", name=f"{loop.name}_child", pos=loop.child_anchor)


def _add_shapes(body: Element, link: Link) -> None:
    """Add a link's inertia, visual shapes and paw to its MJCF body."""
    inertia = link.inertia
    moments = (inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2])
    add(body, "inertial", pos=link.com, mass=link.mass, fullinertia=moments)
    for shape in link.visuals:
        _add_geom(body, shape, class_="visual")
    for paw in link.collisions:
        _add_geom(body, paw, class_="paw", name=f"{link.name[:2]}_paw")


def _add_geom(body: Element, shape: Shape, **attributes: Any) -> None:
    """Add a shape of a link to its MJCF body as a geom; attributes: of the geom."""
    x, y, z, w = shape.rotation
    size = list(shape.size)
    if shape.kind == "box":
        size = [0.5 * edge for edge in size]
    elif shape.kind == "cylinder":
        size = [size[0], 0.5 * size[1]]
    mesh = None if shape.mesh is None else shape.mesh.file.stem
    add(body, "geom", **attributes, type=shape.kind, mesh=mesh, size=size or None,
        pos=shape.position if any(shape.position) else None, quat=(w, x, y, z) if w < 1.0 else None,
        rgba=None if shape.color is None else (*shape.color, 1))  # fmt: skip


def _add_tendons(root: Element, robot: RobotDescription, values: RobotValues) -> None:
    """Add the stops of each leg's outer + inner angle to the MJCF model, and springs between its knees, if any."""
    tendons = add(root, "tendon")
    for leg in LEGS:
        stop = add(tendons, "fixed", name=f"{leg}_sum", range=robot.transversal_sum, solreflimit=(STIFFEST, 1))
        for bar in ("outer", "inner"):
            add(stop, "joint", joint=f"{leg}_{bar}", coef=1)
    if values.spring_stiffness[0, 0] == 0.0:
        return
    for leg in LEGS:
        spring = add(tendons, "spatial", name=f"{leg}_spring", stiffness=values.spring_stiffness[0],
                     springlength=values.spring_length[0])  # fmt: skip
        for bar in ("outer", "inner"):
            add(spring, "site", site=f"{leg}_{bar}_knee")


def _add_actuators(root: Element, robot: RobotDescription) -> None:
    """Add a position servo with gains and torque limit for each motor, and the knees' capped dampers.

    MJCF holds one set of gains: those of jumps.
    """
    actuators = add(root, "actuator")
    for name, motor in zip(MOTOR_JOINTS, robot.motors, strict=True):
        limit = robot.joint(name).effort
        add(actuators, "position", name=name, joint=name, kp=motor.jumping.kp, kv=motor.jumping.kd,
            forcerange=(-limit, limit))  # fmt: skip
    limit = robot.knee_damping_limit
    for joint in robot.joints:
        if joint.name.endswith("knee"):
            add(actuators, "velocity", name=joint.name, joint=joint.name, kv=robot.knee_damping,
                forcerange=(-limit, limit))  # fmt: skip


def _add_keyframe(root: Element, robot: RobotDescription) -> None:
    """Add the standing default pose as a keyframe, its motor angles as targets."""
    q = model.standing_configuration(robot)
    knees = [0.0] * (len(robot.joints) - len(robot.motors))
    add(add(root, "keyframe"), "key", name="default", qpos=(*q[:3], q[6], *q[3:6], *q[7:27]),
        ctrl=(*robot.pose("default"), *knees))  # fmt: skip

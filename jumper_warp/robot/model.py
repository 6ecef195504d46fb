"""Construction of the robot's Newton model and of the leg constants that the kernels read.

Per world, `joint_q` holds the base (position [m], quaternion xyzw), then per leg in FL, FR, BL, BR order the angles
[rad] lateral, outer, outer knee, inner, inner knee, then per leg the quaternion of the ankle's loop joint. Newton's
model is a tree of links plus a loop joint per leg; stiffness and damping below serve its MuJoCo solver, while
SolverJumper has rigid contacts and exact loops.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import newton
import numpy as np
import warp as wp

from jumper_warp.robot.description import LEGS, MOTOR_JOINTS, RobotDescription, load_description
from jumper_warp.robot.gravity import EARTH, check_gravity
from jumper_warp.robot.legs import knee_angles, leg_dimensions
from jumper_warp.robot.parts import Link, Shape
from jumper_warp.robot.values import LINK_KINDS, RobotValues
from jumper_warp.utils.checks import check_count, check_flags, check_number, check_type
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.newton_types import Model
from jumper_warp.utils.runtime import init_warp
from jumper_warp.utils.threads import locked

PHYSICS_DT = 1.0 / 480.0  # [s] Physics step that contacts and loops are tuned for

CONTACT_STIFFNESS = 56689.0
CONTACT_DAMPING = 476.0
"""Contact `ke` [N/m] and `kd` [N s/m]: MuJoCo's solref becomes (2 / kd, kd / (2 sqrt(ke))), critically damped over two
physics steps. Softer contacts cost jump height."""
CONTACT_IMPEDANCE = (0.95, 0.99, 0.001, 0.5, 2.0)  # MuJoCo's solimp: dmin, dmax, width [m], midpoint, power
LOOP_IMPEDANCE = (0.99, 0.999, 0.001, 0.5, 2.0)  # MuJoCo's solimp of the ankles' loops
GROUND_FRICTION = 1.0e-4  # [1] Nearly 0: a contact uses the larger of its two coefficients, here the paw's
MAX_FRICTION = 10.0  # [1] Largest coefficient of the paws, ten times that of rubber on concrete
GROUND_COLOR = (0.42, 0.46, 0.48)  # red, green, blue, 0 to 1
LIMIT_STIFFNESS = CONTACT_STIFFNESS
"""[N m/rad] Stiffness of hard stops: plastic for SolverJumper, critically damped over two physics steps for MuJoCo."""
LIMIT_DAMPING = CONTACT_DAMPING  # [N m s/rad]
NO_EFFORT_LIMIT = 1.0e6
"""[N m] Effort limit of motor joints, never reached, as motor models saturate torque. Knees: limit of the damping."""
KNEE_DOFS = [6 + 5 * leg + joint for leg in range(4) for joint in (2, 4)]
"""Indices of a world's eight knees in its 38 `joint_qd`: outer, inner of each leg."""
MOTOR_DOFS = [6 + 5 * leg + joint for leg in range(4) for joint in (0, 1, 3)]
"""Indices of a world's 12 motors in its 38 `joint_qd`."""
PAWS = tuple(f"{leg}_paw" for leg in LEGS)  # Labels of the paws' shapes, without the world's prefix
PAW_GROUP = -1  # Collision group of the paws: they collide with the ground, but not with each other

Extras = Callable[[newton.ModelBuilder], Any]
"""Adds sites and shapes to the builder of one robot, for every world; its result is ignored."""


@locked
def build_model(
    num_worlds: int,
    *,
    description: RobotDescription | Sequence[RobotDescription] | None = None,
    ground: str | newton.Heightfield | None = "plane",
    friction: float = 0.9,
    gravity: float = EARTH,
    device: wp.DeviceLike = None,
    visuals: bool = True,
    extras: Extras | None = None,
    mujoco: bool = True,
    robot: RobotValues | None = None,
) -> Model:
    """Return a Newton model of `num_worlds` robots, standing in the default pose; labels start with `world_i/`.

    Args:
        description: The robot; by default the project's own. Worlds take several robots in turn.
        ground: "plane" (z = 0), a heightfield, or None for free flight.
        friction: Coulomb friction coefficient of the paws [1].
        gravity: Downward gravity of all worlds [m/s^2]; `model.gravity`, (num_worlds + 1,) vec3, can differ by world.
        visuals: Whether to add shapes that only viewers see. Without them large batches build faster.
        extras: Function that adds the caller's sites and shapes to the builder of one robot; it is called once, and
            every world gets a copy whose labels start with `world_i/`. A link's index is
            `builder.body_label.index("FL_inner_shank")`. Sites and shapes that do not collide work with every solver.
            Colliding shapes and obstacles (body -1) act in Newton's solvers; SolverJumper ignores them with a warning.
            SolverJumper refuses bodies, joints and particles.
        mujoco: Whether to add the attributes of SolverMuJoCo. Without them that solver, which takes a second to
            import, is not imported.
        robot: Masses, joint constants and paw friction that replace the description's, of one robot (N = 1) or of every
            world (N = num_worlds).

    Raises:
        InputError: `num_worlds` no whole number above 0, `friction` not in 0 to 10, `gravity` not in 0 to 100, or an
            unknown `ground`; or an argument of another type.
    """
    num_worlds = check_count("num_worlds", num_worlds)
    check_flags(visuals=visuals, mujoco=mujoco)
    check_number("friction", friction, 0.0, MAX_FRICTION)
    check_gravity(gravity)
    descriptions = described_robots(description)
    check_type("extras", extras, Callable | None)
    check_type("robot", robot, RobotValues | None)
    init_warp()
    builder = _empty_builder(gravity, mujoco)
    one = _robot_builder(descriptions[0], friction, _empty_builder(gravity, mujoco), visuals)
    if extras is not None:
        extras(one)
    builder.replicate(one, num_worlds, label_prefixes=[f"world_{i}" for i in range(num_worlds)])
    _add_ground(builder, ground)
    model: Any = builder.finalize(device=device)
    model.robot_descriptions = descriptions  # for `JumperDynamics`
    if len(descriptions) > 1:
        _write_robots(model, descriptions)
    if robot is not None:
        _write_values(model, robot)
    return model


def described_robots(description: RobotDescription | Sequence[RobotDescription] | None) -> list[RobotDescription]:
    """Return the robots of an argument `description`, by default the project's own. Raises InputError."""
    check_type("description", description, RobotDescription | Sequence[RobotDescription] | None)
    if isinstance(description, RobotDescription):
        return [description]
    if not description:
        return [load_description()]
    robots = list(description)
    for name in ("poses", "transversal_sum", "knee_damping_limit", "knee_damping", "motors"):
        if any(getattr(robot, name) != getattr(robots[0], name) for robot in robots):
            raise InputError(f"robots of one environment must have equal {name}")
    return robots


def _write_robots(model: Model, robots: list[RobotDescription]) -> None:
    """Write masses, lengths, joints and standing poses of robots, which worlds take in turn, to a model of the first.

    Shapes that only viewers see stay those of the first robot.
    """
    builders = [_robot_builder(robot, 0.0, _empty_builder(0.0, False), False) for robot in robots]
    n = model.world_count
    turns = np.arange(n) % len(robots)
    for name in ("body_mass", "body_com", "body_inertia", "joint_X_p", "joint_X_c", "joint_armature", "joint_friction",
                 "joint_limit_lower", "joint_limit_upper", "joint_q"):  # fmt: skip
        each = np.array([np.array([np.array(row) for row in getattr(one, name)]) for one in builders], dtype=np.float32)
        getattr(model, name).assign(each[turns].reshape(getattr(model, name).numpy().shape))
    model.body_inv_mass.assign(1.0 / model.body_mass.numpy())
    model.body_inv_inertia.assign(np.linalg.inv(model.body_inertia.numpy().astype(np.float64)).astype(np.float32))
    paws = [index for index, label in enumerate(model.shape_label) if label.split("/")[-1] in PAWS]
    for name in ("shape_transform", "shape_scale"):
        values = getattr(model, name).numpy()
        each = np.array([np.array([np.array(row) for row in getattr(one, name)]) for one in builders], dtype=np.float32)
        values[paws] = each[turns].reshape(len(paws), -1)
        getattr(model, name).assign(values)


def _write_values(model: Model, robots: RobotValues) -> None:
    """Give a model of the description the masses, joint constants and paw friction of given robots.

    Newton's bodies of a world are the base, then the links of each leg in the order of LINK_KINDS. `base_mass` [kg] and
    `base_com` [m] replace the base's values; `link_mass` (worlds, kinds of links) and `base_inertia` are factors. The
    inertia of a body grows with its mass, that of the base by `base_inertia` besides.
    """
    n = model.world_count
    mass = model.body_mass.numpy().reshape(n, -1)
    com = model.body_com.numpy().reshape(n, -1, 3)
    inertia = model.body_inertia.numpy().reshape(n, -1, 3, 3)
    scale = np.tile(robots.link_mass, (1, 4)) * np.ones((n, 4 * len(LINK_KINDS)))
    base_ratio = robots.base_mass[:, 0] / mass[:, 0]
    inertia[:, 0] *= (base_ratio * robots.base_inertia[:, 0])[:, None, None]
    inertia[:, 1:] *= scale[:, :, None, None]
    mass[:, 0] = robots.base_mass[:, 0]
    com[:, 0] = robots.base_com
    mass[:, 1:] *= scale
    for array, values in (
        (model.body_mass, mass),
        (model.body_inv_mass, 1.0 / mass),
        (model.body_com, com),
        (model.body_inertia, inertia),
        (model.body_inv_inertia, np.linalg.inv(inertia.astype(np.float64))),
    ):
        array.assign(np.ascontiguousarray(values, dtype=np.float32).reshape(array.numpy().shape))
    for array, dofs, values in (
        (model.joint_armature, MOTOR_DOFS, robots.armature),
        (model.joint_friction, MOTOR_DOFS, robots.motor_friction),
        (model.joint_damping, KNEE_DOFS, robots.knee_damping),
    ):
        table = array.numpy().reshape(n, -1)
        table[:, dofs] = values
        array.assign(table.ravel())
    friction = model.shape_material_mu.numpy()
    paws = [index for index, label in enumerate(model.shape_label) if label.split("/")[-1] in PAWS]
    friction[np.reshape(paws, (n, -1))] = robots.paw_friction
    model.shape_material_mu.assign(friction)


def other_colliders(model: Model) -> np.ndarray:
    """Return the shape indices (n,) int of the colliding shapes that are neither paws nor the shared ground."""
    flags = model.shape_flags.numpy()
    worlds = model.shape_world.numpy()
    kinds = model.shape_type.numpy()
    ground = (worlds == -1) & np.isin(kinds, [int(newton.GeoType.PLANE), int(newton.GeoType.HFIELD)])
    colliding = np.flatnonzero(((flags & int(newton.ShapeFlags.COLLIDE_SHAPES)) != 0) & ~ground)
    return np.array([i for i in colliding if model.shape_label[i].split("/")[-1] not in PAWS], dtype=int)


def leg_geometry(description: RobotDescription) -> list[dict]:
    """Return the lengths that define each leg's geometry, one dict per leg in FL, FR, BL, BR order.

    The keys are the names of the fields of the kernels' `LegGeometry`.
    """
    return [dataclasses.asdict(leg_dimensions(description, leg)) for leg in LEGS]


def leg_geometry_array(
    description: RobotDescription | Sequence[RobotDescription], geometry_module: ModuleType,
    device: wp.DeviceLike = None,
) -> wp.array:  # fmt: skip
    """Return the legs' geometry as an array (4 robots,) of the kernels' struct `LegGeometry`.

    geometry_module: kernel module that defines the struct, in single or double precision.
    """
    legs = []
    for fields in (fields for robot in described_robots(description) for fields in leg_geometry(robot)):
        leg = geometry_module.LegGeometry()
        for name, value in fields.items():
            setattr(leg, name, value)
        legs.append(leg)
    return wp.array(legs, dtype=geometry_module.LegGeometry, device=device)


def standing_configuration(description: RobotDescription, pose: str = "default") -> np.ndarray:
    """Return one world's joint coordinates in a standing pose: level base at x = y = 0, lowest paws touching z = 0.

    Shape (43,), as `joint_q`. Raises KeyError for an unknown pose.
    """
    angles = description.pose(pose).reshape(4, 3)
    joints = []
    loops = []
    depths = []
    for name, (lateral, outer, inner) in zip(LEGS, angles, strict=True):
        leg = leg_dimensions(description, name)
        outer_knee, inner_knee, _ = knee_angles(leg, outer, inner)
        joints += [lateral, outer, outer_knee, inner, inner_knee]
        # both shanks turn about the housing's y, the outer one by front * (knee - thigh), the inner one the other way
        half_turn = 0.5 * leg.front * (outer_knee - outer + inner_knee - inner)
        loops += [0.0, math.sin(half_turn), 0.0, math.cos(half_turn)]
        depths.append(leg.depth(lateral, outer) - leg.hip[2])
    base = [0.0, 0.0, max(depths), 0.0, 0.0, 0.0, 1.0]
    return np.array(base + joints + loops)


def _empty_builder(gravity: float, mujoco: bool) -> newton.ModelBuilder:
    """Return a Newton builder without bodies; gravity [m/s^2]: downward; mujoco: as in `build_model`."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -gravity))
    if mujoco:
        newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    return builder


def _contact_attributes(builder: newton.ModelBuilder) -> dict[str, Any]:
    """Return the attributes of a colliding shape for SolverMuJoCo; none if the builder lacks them."""
    name = "mujoco:geom_solimp"
    return {name: CONTACT_IMPEDANCE} if builder.has_custom_attribute(name) else {}


def _robot_builder(
    description: RobotDescription, friction: float, builder: newton.ModelBuilder, visuals: bool
) -> newton.ModelBuilder:
    """Add one robot in the default pose to an empty Newton builder, and return it; friction [1] of the paws."""
    bodies = {}
    for link in description.links:
        bodies[link.name] = builder.add_link(
            mass=link.mass,
            com=wp.vec3(*link.com),
            inertia=wp.mat33(*link.inertia.flatten()),
            lock_inertia=True,
            label=link.name,
        )
    meshes: dict[int, newton.Mesh] = {}
    for link in description.links:
        if visuals:
            _add_visuals(builder, bodies[link.name], link, meshes)
        for paw in link.collisions:
            _add_paw(builder, bodies[link.name], paw, f"{link.name[:2]}_paw", friction, visible=not visuals)
    _add_joints(builder, bodies, description)
    builder.joint_q[:] = [float(value) for value in standing_configuration(description)]
    return builder


def _add_joints(builder: newton.ModelBuilder, bodies: dict[str, int], description: RobotDescription) -> None:
    """Add base and hinges to a Newton builder as one articulation, then the loop joints; bodies: index by link."""
    motors = dict(zip(MOTOR_JOINTS, description.motors, strict=True))
    tree = [builder.add_joint_free(bodies["body"], label="base")]
    for joint in description.joints:
        motor = motors.get(joint.name)
        tree.append(
            builder.add_joint_revolute(
                bodies[joint.parent],
                bodies[joint.child],
                parent_xform=wp.transform(joint.origin, wp.quat_identity()),
                axis=wp.vec3(*joint.axis),
                limit_lower=joint.lower,
                limit_upper=joint.upper,
                limit_ke=LIMIT_STIFFNESS,
                limit_kd=LIMIT_DAMPING,
                armature=motor.armature if motor else 0.0,
                friction=motor.coulomb_friction if motor else 0.0,
                damping=0.0 if motor else description.knee_damping,
                effort_limit=NO_EFFORT_LIMIT if motor else description.knee_damping_limit,
                label=joint.name,
            )
        )
    builder.add_articulation(tree, label="jumper")
    for loop in description.loops:
        builder.add_joint_ball(
            bodies[loop.parent],
            bodies[loop.child],
            parent_xform=wp.transform(loop.parent_anchor, wp.quat_identity()),
            child_xform=wp.transform(loop.child_anchor, wp.quat_identity()),
            label=loop.name,
        )


def _add_paw(
    builder: newton.ModelBuilder, body: int, paw: Shape, label: str, friction: float, *, visible: bool
) -> None:
    """Add a paw's collision sphere to a body of a Newton builder.

    friction: Coulomb coefficient [1]; visible: whether viewers show it.
    """
    config = newton.ModelBuilder.ShapeConfig(
        density=0.0,
        mu=friction,
        ke=CONTACT_STIFFNESS,
        kd=CONTACT_DAMPING,
        collision_group=PAW_GROUP,
        is_visible=visible,
    )
    builder.add_shape_sphere(
        body,
        xform=wp.transform(paw.position, wp.quat(*paw.rotation)),
        radius=paw.size[0],
        cfg=config,
        label=label,
        custom_attributes=_contact_attributes(builder),
    )


def _add_visuals(builder: newton.ModelBuilder, body: int, link: Link, meshes: dict[int, newton.Mesh]) -> None:
    """Add a link's shapes, visible only, to a body of a Newton builder; meshes: cache by id of the mesh."""
    config = newton.ModelBuilder.ShapeConfig(density=0.0, has_shape_collision=False, has_particle_collision=False)
    for index, shape in enumerate(link.visuals):
        common = {
            "xform": wp.transform(shape.position, wp.quat(*shape.rotation)),
            "cfg": config,
            "color": shape.color,
            "label": f"{link.name}_visual_{index}",
        }
        if shape.kind == "box":
            hx, hy, hz = (0.5 * edge for edge in shape.size)
            builder.add_shape_box(body, hx=hx, hy=hy, hz=hz, **common)
        elif shape.kind == "cylinder":
            builder.add_shape_cylinder(body, radius=shape.size[0], half_height=0.5 * shape.size[1], **common)
        elif shape.kind == "sphere":
            builder.add_shape_sphere(body, radius=shape.size[0], **common)
        elif shape.mesh is not None:
            mesh = meshes.get(id(shape.mesh))
            if mesh is None:
                mesh = newton.Mesh(shape.mesh.vertices, shape.mesh.triangles.flatten(), compute_inertia=False)
                meshes[id(shape.mesh)] = mesh
            builder.add_shape_mesh(body, mesh=mesh, **common)


def _add_ground(builder: newton.ModelBuilder, ground: str | newton.Heightfield | None) -> None:
    """Add the ground that all worlds share to a Newton builder: "plane", a heightfield or None. Raises InputError."""
    config = newton.ModelBuilder.ShapeConfig(density=0.0, mu=GROUND_FRICTION, ke=CONTACT_STIFFNESS, kd=CONTACT_DAMPING)
    common = {
        "cfg": config,
        "color": GROUND_COLOR,
        "label": "ground",
        "custom_attributes": _contact_attributes(builder),
    }
    if isinstance(ground, newton.Heightfield):
        builder.add_shape_heightfield(heightfield=ground, **common)
    elif isinstance(ground, str) and ground == "plane":
        builder.add_shape_plane(plane=(0.0, 0.0, 1.0, 0.0), width=0.0, length=0.0, **common)
    elif ground is not None:
        raise InputError(f'ground must be "plane", a newton.Heightfield or None, got {ground!r}')

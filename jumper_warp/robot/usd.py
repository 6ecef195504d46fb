"""Export of the robot as a USD stage: an articulation in the standing pose, and loop joints excluded from it."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.robot.model import standing_configuration
from jumper_warp.robot.parts import MOTOR_JOINTS, Joint, Link, Loop, Motor, RobotDescription, Shape
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import write_atomically
from jumper_warp.utils.rotations import from_rotation_vector, multiply, rotate

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
DEGREES = np.pi / 180.0  # [rad]


def write_usd(path: Path, robot: RobotDescription, paw_friction: float) -> Path:
    """Write the robot as a .usda file, without ground, and return its path; paw_friction: Coulomb coefficient [1].

    Raises InputError: the package `usd-core` is not installed.
    """
    try:
        stage = importlib.import_module("pxr.Usd").Stage.CreateInMemory()
    except ImportError:
        raise InputError('USD needs the package usd-core: pip install "jumper-warp[usd]"') from None
    UsdStage(stage, robot).write(paw_friction)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, stage.GetRootLayer().ExportToString().encode())
    return path


class UsdStage:
    """Writer of a robot to a USD stage: z up, metres, kilograms; angles of USD's joints are in degrees."""

    def __init__(self, stage: Any, robot: RobotDescription) -> None:
        """Prepare an empty `pxr.Usd.Stage` for a robot."""
        self.stage, self.robot = stage, robot
        names = ("Gf", "Sdf", "UsdGeom", "UsdPhysics", "UsdShade", "Vt")
        self.gf, self.sdf, self.geom, self.physics, self.shade, self.vt = (
            importlib.import_module(f"pxr.{name}") for name in names
        )
        q = standing_configuration(robot)
        self.angles = {joint.name: float(angle) for joint, angle in zip(robot.joints, q[7:27], strict=True)}
        self.frames = {"body": (q[:3], IDENTITY)}  # position [m] and quaternion xyzw of each link, world frame
        for joint in robot.joints:
            place, quat = self.frames[joint.parent]
            turned = multiply(quat, from_rotation_vector(self.angles[joint.name] * joint.axis))
            self.frames[joint.child] = (place + rotate(quat, joint.origin), turned)

    def write(self, paw_friction: float) -> None:
        """Write links, joints and loops to the USD stage under the default prim /jumper.

        paw_friction: Coulomb friction coefficient of the paws [1].
        """
        self.geom.SetStageUpAxis(self.stage, self.geom.Tokens.z)
        self.geom.SetStageMetersPerUnit(self.stage, 1.0)
        self.physics.SetStageKilogramsPerUnit(self.stage, 1.0)
        root = self.geom.Xform.Define(self.stage, "/jumper").GetPrim()
        self.stage.SetDefaultPrim(root)
        self.physics.ArticulationRootAPI.Apply(root)
        for schema, name in (("NewtonArticulationRootAPI", "newton:selfCollisionEnabled"),
                             ("PhysxArticulationAPI", "physxArticulation:enabledSelfCollisions")):  # fmt: skip
            root.AddAppliedSchema(schema)
            root.CreateAttribute(name, self.sdf.ValueTypeNames.Bool).Set(False)
        rubber = self.shade.Material.Define(self.stage, "/jumper/paw_material")
        material = self.physics.MaterialAPI.Apply(rubber.GetPrim())
        material.CreateStaticFrictionAttr(paw_friction)
        material.CreateDynamicFrictionAttr(paw_friction)
        for link in self.robot.links:
            self._add_link(link, rubber)
        motors = dict(zip(MOTOR_JOINTS, self.robot.motors, strict=True))
        for joint in self.robot.joints:
            self._add_hinge(joint, motors.get(joint.name))
        for loop in self.robot.loops:
            self._add_loop(loop)

    def _quat(self, xyzw: np.ndarray) -> Any:
        """Convert a quaternion xyzw to USD's `Gf.Quatf`."""
        x, y, z, w = map(float, xyzw)
        return self.gf.Quatf(w, x, y, z)

    def _place(self, prim: Any, position: np.ndarray, rotation: np.ndarray) -> None:
        """Write the position [m] and rotation xyzw of a USD prim in its parent's frame."""
        xform = self.geom.Xformable(prim)
        xform.AddTranslateOp().Set(self.gf.Vec3d(*map(float, position)))
        xform.AddOrientOp().Set(self._quat(rotation))

    def _add_link(self, link: Link, rubber: Any) -> None:
        """Add a link to the USD stage as a rigid body, with shapes and, on inner shanks, the paw of `rubber`."""
        prim = self.geom.Xform.Define(self.stage, f"/jumper/{link.name}").GetPrim()
        self._place(prim, *self.frames[link.name])
        self.physics.RigidBodyAPI.Apply(prim)
        moments, axes = np.linalg.eigh(link.inertia)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        mass = self.physics.MassAPI.Apply(prim)
        mass.CreateMassAttr(float(link.mass))
        mass.CreateCenterOfMassAttr(self.gf.Vec3f(*map(float, link.com)))
        mass.CreateDiagonalInertiaAttr(self.gf.Vec3f(*map(float, moments)))
        matrix = self.gf.Matrix3d(*(float(value) for value in axes.T.ravel()))  # USD's vectors are rows
        mass.CreatePrincipalAxesAttr(self.gf.Quatf(matrix.ExtractRotation().GetQuat()))
        for index, shape in enumerate(link.visuals):
            self._add_shape(f"/jumper/{link.name}/visual_{index}", shape)
        for paw in link.collisions:
            prim = self._add_shape(f"/jumper/{link.name}/{link.name[:2]}_paw", paw)
            self.geom.Imageable(prim).CreatePurposeAttr(self.geom.Tokens.guide)
            self.physics.CollisionAPI.Apply(prim)
            self.shade.MaterialBindingAPI.Apply(prim).Bind(rubber, materialPurpose="physics")

    def _add_shape(self, path: str, shape: Shape) -> Any:
        """Add a shape to the USD stage under its link, and return its prim."""
        if shape.mesh is not None:
            gprim = self.geom.Mesh.Define(self.stage, path)
            triangles = shape.mesh.triangles
            gprim.CreatePointsAttr(self.vt.Vec3fArray.FromNumpy(shape.mesh.vertices.astype(np.float32)))
            gprim.CreateFaceVertexIndicesAttr(self.vt.IntArray.FromNumpy(triangles.ravel()))
            gprim.CreateFaceVertexCountsAttr(self.vt.IntArray([3] * len(triangles)))
            gprim.CreateSubdivisionSchemeAttr(self.geom.Tokens.none)
        elif shape.kind == "sphere":
            gprim = self.geom.Sphere.Define(self.stage, path)
            gprim.CreateRadiusAttr(shape.size[0])
        elif shape.kind == "cylinder":
            gprim = self.geom.Cylinder.Define(self.stage, path)
            gprim.CreateRadiusAttr(shape.size[0])
            gprim.CreateHeightAttr(shape.size[1])
        else:
            gprim = self.geom.Cube.Define(self.stage, path)
            gprim.CreateSizeAttr(1.0)
        self._place(gprim.GetPrim(), shape.position, shape.rotation)
        if shape.kind == "box":
            gprim.AddScaleOp().Set(self.gf.Vec3f(*shape.size))
        if shape.color is not None:
            gprim.CreateDisplayColorAttr([self.gf.Vec3f(*shape.color)])
        return gprim.GetPrim()

    def _add_joint(self, schema: Any, name: str, ends: list[tuple[str, np.ndarray]], rotation: np.ndarray) -> Any:
        """Add a joint of two links to the USD stage; ends: (link, point [m] in its frame); rotation: in both frames."""
        joint = schema.Define(self.stage, f"/jumper/joints/{name}")
        for index, (link, point) in enumerate(ends):
            getattr(joint, f"CreateBody{index}Rel")().SetTargets([f"/jumper/{link}"])
            getattr(joint, f"CreateLocalPos{index}Attr")(self.gf.Vec3f(*map(float, point)))
            getattr(joint, f"CreateLocalRot{index}Attr")(self._quat(rotation))
        return joint

    def _add_hinge(self, hinge: Joint, motor: Motor | None) -> None:
        """Add a hinge to the USD stage with stops, armature, friction and a drive.

        The drive is a motor's, or a knee's damping up to its limit.
        """
        robot = self.robot
        angle = self.angles[hinge.name]
        axis = hinge.axis
        # the joint's x axis turned onto the hinge's axis, which is along x or y
        turn = from_rotation_vector(np.array([0.0, 0.0, np.arctan2(axis[1], axis[0])]))
        ends = [(hinge.parent, hinge.origin), (hinge.child, np.zeros(3))]
        joint = self._add_joint(self.physics.RevoluteJoint, hinge.name, ends, turn)
        joint.CreateAxisAttr("X")
        joint.CreateLowerLimitAttr(hinge.lower / DEGREES)
        joint.CreateUpperLimitAttr(hinge.upper / DEGREES)
        prim = joint.GetPrim()
        drive = self.physics.DriveAPI.Apply(prim, "angular")
        drive.CreateTypeAttr("force")
        drive.CreateStiffnessAttr(motor.jumping.kp * DEGREES if motor else 0.0)
        drive.CreateDampingAttr((motor.jumping.kd if motor else robot.knee_damping) * DEGREES)
        drive.CreateMaxForceAttr(hinge.effort if motor else robot.knee_damping_limit)
        if motor is not None:
            drive.CreateTargetPositionAttr(angle / DEGREES)
        values = {"state:angular:physics:position": angle / DEGREES}
        if motor is not None:
            values |= {"newton:armature": motor.armature, "newton:friction": motor.coulomb_friction}
            values |= {"physxJoint:armature": motor.armature, "physxJoint:maxJointVelocity": hinge.velocity / DEGREES}
        for schema in ("PhysicsJointStateAPI:angular", "NewtonJointAPI", "PhysxJointAPI"):
            prim.AddAppliedSchema(schema)
        for name, value in values.items():
            prim.CreateAttribute(name, self.sdf.ValueTypeNames.Float).Set(value)

    def _add_loop(self, loop: Loop) -> None:
        """Add a ball joint that closes a loop to the USD stage, outside the articulation."""
        ends = [(loop.parent, loop.parent_anchor), (loop.child, loop.child_anchor)]
        joint = self._add_joint(self.physics.SphericalJoint, loop.name, ends, IDENTITY)
        joint.CreateExcludeFromArticulationAttr(True)

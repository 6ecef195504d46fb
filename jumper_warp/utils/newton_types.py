"""Newton's Model, State and Control with non-optional arrays, for type checkers; at run time, Newton's classes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import newton

if TYPE_CHECKING:
    from collections.abc import Callable

    import warp as wp

    class State(newton.State):
        """`newton.State`, with arrays that are not optional."""

        joint_q: wp.array  # (joint_coord_count,) float [m, rad or quaternion xyzw]
        joint_qd: wp.array  # (joint_dof_count,) float [m/s or rad/s]
        body_q: wp.array  # (body_count,) transform, world
        body_qd: wp.array  # (body_count,) spatial vector, world: linear [m/s], angular [rad/s]
        body_f: wp.array  # (body_count,) spatial vector, world: force [N], torque [N m]

    class Control(newton.Control):
        """`newton.Control`, with an array that is not optional."""

        joint_f: wp.array  # (joint_dof_count,) float [N or N m]

    class Model(newton.Model):
        """`newton.Model`, with arrays that are not optional; Newton documents shapes and units."""

        body_com: wp.array
        body_inertia: wp.array
        body_inv_inertia: wp.array
        body_inv_mass: wp.array
        body_mass: wp.array
        body_q: wp.array
        body_qd: wp.array
        body_world: wp.array
        gravity: wp.array
        joint_armature: wp.array
        joint_axis: wp.array
        joint_damping: wp.array
        joint_f: wp.array
        joint_friction: wp.array
        joint_mimic_joint: wp.array
        joint_q: wp.array
        joint_qd: wp.array
        joint_qd_start: wp.array
        joint_X_p: wp.array
        shape_body: wp.array
        shape_color: wp.array
        shape_flags: wp.array
        shape_material_mu: wp.array
        shape_scale: wp.array
        shape_source: list[Any]
        shape_transform: wp.array
        shape_type: wp.array
        shape_world: wp.array
        state: Callable[..., State]
        control: Callable[..., Control]
else:
    Model, State, Control = newton.Model, newton.State, newton.Control

"""Newton's inverse kinematics with the robot's loops."""

import newton
import newton.ik as ik
import numpy as np
import pytest
import warp as wp

from jumper_warp.sim.simulation import Simulation


def ankle_ends(model):
    """Return (body, anchor [m] in its frame) of both ends of the FL ankle."""
    joint = model.joint_label.index("world_0/FL_ankle")
    bodies = (model.joint_parent, model.joint_child)
    anchors = (model.joint_X_p, model.joint_X_c)
    return [(int(b.numpy()[joint]), wp.vec3(*a.numpy()[joint, :3])) for b, a in zip(bodies, anchors, strict=True)]


@pytest.mark.parametrize(("shanks", "low", "high"), [(1, 8.0, 85.0), (2, 0.0, 0.01)])
def test_inverse_kinematics_closes_the_loop_with_both_shanks(shanks, low, high):
    sim = Simulation(1, visuals=False, device="cpu")
    model, state = sim.model, sim.state
    ends = ankle_ends(model)
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    body, anchor = ends[0]
    paw = np.array(wp.transform_point(wp.transform(*state.body_q.numpy()[body]), anchor))
    target = wp.array([wp.vec3(*(paw + [0.03, 0.0, 0.05]))], dtype=wp.vec3, device="cpu")
    base = wp.array([wp.vec3(*state.joint_q.numpy()[:3])], dtype=wp.vec3, device="cpu")
    upright = wp.array([wp.vec4(0.0, 0.0, 0.0, 1.0)], dtype=wp.vec4, device="cpu")
    objectives = [ik.IKObjectivePosition(*end, target) for end in ends[:shanks]]
    objectives += [
        ik.IKObjectivePosition(0, wp.vec3(0.0), base, weight=10.0),
        ik.IKObjectiveRotation(0, wp.quat_identity(), upright, weight=10.0),
    ]
    q = wp.array(state.joint_q.numpy()[None], dtype=float, device="cpu")
    ik.IKSolver(model, 1, objectives, jacobian_mode=ik.IKJacobianType.ANALYTIC).step(q, q, iterations=30)
    state.joint_q.assign(q.numpy().ravel())
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    reached = np.array(wp.transform_point(wp.transform(*state.body_q.numpy()[body]), anchor))
    assert reached == pytest.approx(target.numpy()[0], abs=1.0e-3)  # [m]
    assert low <= 1.0e3 * sim.loop_gap()[0] <= high  # [mm]
    sim.physics.dynamics.full_state(state.joint_q, state.joint_qd, state.body_q, state.body_qd)
    assert 1.0e3 * sim.loop_gap()[0] < 1.0e-3

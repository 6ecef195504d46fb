import numpy as np
import pytest
import torch
import warp as wp

from jumper_warp.diff.fixed_rollout import FixedRollout
from jumper_warp.diff.rollout import Rollout
from jumper_warp.robot.model import build_model
from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter


@pytest.mark.parametrize("by_legs", [False, True])
def test_passes_agree_with_those_of_a_rollout_whatever_passed_before(by_legs, monkeypatch):
    """The motion is equal bitwise, the gradient w.r.t. targets up to rounding; passes have several lengths."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", by_legs)
    model = build_model(2, visuals=False, device="cpu")
    whole, fixed = (
        kind(model, jumping_motors(), vertical_jump_filter(), double=True) for kind in (Rollout, FixedRollout)
    )
    whole.by_legs = fixed.by_legs = by_legs
    fixed.allocate(9)
    q, qd = whole.standing()
    rng = np.random.default_rng(0)
    for count in (9, 4, 7):
        targets = rng.uniform(0.2, 1.0, (count, 12, 2))
        motion = whole.run(targets, q, qd, initial_target=q[7:])
        rows = fixed.forward(targets, q, qd, q[7:])
        np.testing.assert_array_equal(fixed.q[:rows], motion.q.numpy())
        np.testing.assert_array_equal(fixed.qd[:rows], motion.qd.numpy())
        by_q, by_qd = (wp.array(rng.normal(size=array.shape), dtype=wp.float64) for array in (motion.q, motion.qd))
        fixed.by_q[:rows], fixed.by_qd[:rows] = torch.as_tensor(by_q.numpy()), torch.as_tensor(by_qd.numpy())
        expected = whole.backward(motion, q=by_q, qd=by_qd)["targets"].numpy()
        np.testing.assert_allclose(fixed.reverse(), expected, atol=1.0e-9 * np.abs(expected).max())

"""Metrics of held squats by hand, and the experiment at a tiny size."""

import numpy as np
import pytest

from experiments import squat_hold
from experiments.squat_hold import SquatLog
from jumper_warp.utils.output import read_values
from metric_helpers import values

pytestmark = pytest.mark.usefixtures("one_thread")


def squat_log(steps, **changes):
    """Return the log of three robots, of which robot 2 ends at the last step; steps: paw forces [N], (4,), by step.

    Peak forces are 1, 2 and 900 N larger; torques alternate between 0 and 2 N m; the base moves by 0.01 m a step.
    """
    squats = SquatLog(np.zeros((3, 3)))
    for step, force in enumerate(steps):
        arrays = {
            "force": np.tile(force, (3, 1)), "peak": np.tile(force, (3, 1)) + [[1.0], [2.0], [900.0]],
            "torque": np.full((3, 12), 2.0 * (step % 2)), "position": np.full((3, 2), [0.01 * step, 0.0]),
            "termination": np.array([-1, -1, step - len(steps) + 1]),
        }  # fmt: skip
        squats.update(arrays | changes, 1.0 / 60.0)
    return squats


def test_squat_metrics_match_hand_computed_values(monkeypatch):
    monkeypatch.setattr(squat_hold, "WINDOW", 2)
    squats = squat_log([np.full(4, 500.0), np.full(4, 40.0), np.array([40.0, 43.0, 40.0, 0.0])])
    np.testing.assert_array_equal(squats.ended, [False, False, True])
    metrics = values(squats.metrics())
    # the last two steps: the fourth paw between its peak of 40 + 1 or 2 and 0
    assert (metrics["paw_force_range_mean_n"], metrics["paw_force_range_max_n"]) == (41.5, 42.0)
    assert metrics["holding_rate"] == pytest.approx(2.0 / 3.0) and metrics["lost_paw_share_mean"] == 1.0 / 8.0
    assert metrics["torque_ripple_mean_nm"] == 1.0 and metrics["drift_mean_m"] == pytest.approx(0.02)


def test_squat_metrics_are_none_if_no_robot_holds():
    metrics = values(squat_log([np.ones(4)] * 2, termination=np.zeros(3)).metrics())
    assert metrics["holding_rate"] == 0.0
    assert all(value is None for name, value in metrics.items() if name != "holding_rate")


@pytest.mark.parametrize("policy", ["vertical_jump", "horizontal_jump", "slippery_waiting_jump"])
def test_shipped_policies_hold_their_squats(policy, tmp_path):
    args = squat_hold.Args(policy=policy, num_squats=2, num_recorded=0, out=tmp_path, device="cpu")
    saved = squat_hold.main(args)
    assert saved == read_values(tmp_path)
    assert saved["holding_rate"] == 1.0 and saved["lost_paw_share_mean"] == 0.0
    assert 0.0 < saved["paw_force_range_max_n"] < 1.0

"""Metrics of held squats by hand, and the experiment at a tiny size."""

import numpy as np
import pytest

from experiments import squat_hold
from jumper_warp.utils.output import read_values
from metric_helpers import values
from support.squats import SquatLog, squat_metrics

pytestmark = pytest.mark.usefixtures("one_thread")


def squat_log(steps, **changes):
    """Return the log of three robots, of which robot 2 ends at step 2; steps: paw forces [N], (4,), by policy step.

    Peak forces are 1, 2 and 900 N larger; torques alternate between 0 and 2 N m.
    """
    squats = SquatLog(np.zeros((3, 3)), hold=1.5, window=2.0 / 60.0)
    for step, force in enumerate(steps):
        arrays = {
            "force": np.tile(force, (3, 1)), "peak": np.tile(force, (3, 1)) + [[1.0], [2.0], [900.0]],
            "torque": np.full((3, 12), 2.0 * (step % 2)), "termination": np.array([-1, -1, step - 2]),
        }  # fmt: skip
        squats.update(arrays | changes, 1.0 / 60.0)
    return squats


def test_squat_metrics_match_hand_computed_values():
    squats = squat_log([np.full(4, 500.0), np.full(4, 40.0), np.array([40.0, 43.0, 40.0, 0.0])])
    np.testing.assert_array_equal(squats.ended, [False, False, True])
    # the last two steps: the fourth paw between its peak of 40 + 1 or 2 and 0
    np.testing.assert_allclose(squats.force_range, [41.0, 42.0])
    np.testing.assert_allclose(squats.torque_ripple, 1.0)
    metrics = values(squat_metrics(squats))
    assert metrics["holding_rate"] == pytest.approx(2.0 / 3.0) and metrics["lost_paw_share_mean"] == 1.0 / 8.0
    assert (metrics["paw_force_range_mean_n"], metrics["paw_force_range_max_n"]) == (41.5, 42.0)


def test_squat_metrics_are_none_if_no_robot_holds():
    metrics = values(squat_metrics(squat_log([np.ones(4)] * 2, termination=np.zeros(3))))
    assert metrics["holding_rate"] == 0.0
    assert all(value is None for name, value in metrics.items() if name != "holding_rate")


@pytest.mark.parametrize("policy", ["vertical_jump", "horizontal_jump", "slippery_waiting_jump"])
def test_shipped_policies_hold_their_squats(policy, tmp_path):
    args = squat_hold.Args(policy=policy, num_squats=2, num_recorded=0, out=tmp_path, device="cpu")
    saved = squat_hold.main(args)
    assert saved == read_values(tmp_path)
    assert saved["holding_rate"] == 1.0 and saved["lost_paw_share_mean"] == 0.0
    assert 0.0 < saved["paw_force_range_max_n"] < 1.0
    assert (tmp_path / "hold.png").is_file()

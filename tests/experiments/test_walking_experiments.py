"""Walking experiments with a policy that stands still: commands, outputs and refused settings."""

import numpy as np
import pytest

from experiments import walking_terrain, walking_tracking
from jumper_warp.policies.policy import save_policy
from jumper_warp.registry import make_task
from jumper_warp.utils.output import read_values
from landing_helpers import still_policy

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    """Folder with a subfolder per task that holds a policy which stands still."""
    folder = tmp_path_factory.mktemp("policies")
    for name in ("velocity-flat", "horizontal-jump"):
        save_policy(folder / name, still_policy(name))
    return folder


def test_standing_policy_has_rmse_of_command_and_gait_of_standing(policies, tmp_path):
    args = walking_tracking.Args(
        policy=str(policies / "velocity-flat"), commands_per_axis=2, num_recorded=0, out=tmp_path, device="cpu"
    )
    values = walking_tracking.main(args)
    metrics = read_values(tmp_path)
    assert metrics == values and (tmp_path / "tracking.png").is_file()
    for name in ("rmse_vx_m_s", "settled_rmse_vy_m_s", "rmse_yaw_rate_rad_s"):
        assert metrics[name] == pytest.approx(0.8, abs=0.02)
    assert 0.6 < metrics["slewed_rmse_vx_m_s"] < 0.8 and metrics["standing_drift_mean_m"] < 0.01
    assert (metrics["fall_rate"], metrics["settling_time_median_s"]) == (0.0, None)
    assert metrics["top_ahead_m_s"] == metrics["top_turning_rad_s"] == metrics["steps_hz"] == 0.0
    assert metrics["share_down_FL_FR_BL_BR"] == 1.0 and metrics["cost_of_transport"] is None
    assert metrics["kicked_fall_rate"] == 0.0


def test_standing_policy_has_zero_success_on_terrains(policies, tmp_path):
    args = walking_terrain.Args(
        policy=str(policies / "velocity-flat"), num_robots=3, terrains=("flat", "stairs"), num_recorded=1, out=tmp_path,
        device="cpu",
    )  # fmt: skip
    metrics = walking_terrain.main(args)
    assert metrics["flat_walked_fraction_mean"] < 0.02 and metrics["stairs_walked_fraction_mean"] < 0.02
    assert metrics["flat_fall_rate"] == 0.0 and (tmp_path / "terrain.png").is_file()
    assert (tmp_path / "stairs.rrd").stat().st_size > 10_000 and (tmp_path / "flat.png").stat().st_size > 10_000


def test_kicked_and_sped_up_walks_have_specified_kicks_and_speeds():
    class Env:  # stub with the attributes that the walks read
        num_envs, task, step_dt = 16, make_task("velocity-flat"), 1.0 / 60.0

    kicked = walking_tracking.kicked_walks(Env, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(kicked.kick, axis=1), 0.5)  # [m/s]
    assert kicked.kick_time.min() >= 2.0 and kicked.kick_time.max() <= 4.0  # [s]
    fast, direction = walking_tracking.sped_up_walks(Env)  # direction of each walk: 1 backward, 2 sideways, 3 turning
    ahead, left, _ = fast.commands[:, -1].T  # the last, fastest command [m/s]
    np.testing.assert_allclose(ahead[direction == 1], -np.linspace(0.3, 4.0, 4))
    np.testing.assert_allclose(left[direction == 2], np.linspace(0.3, 2.0, 4))
    assert not ahead[direction == 3].any() and not left[direction == 3].any() and fast.times[-1] < 3.0

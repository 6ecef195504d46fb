"""The walking experiments with a policy that stands still: what they ask, write and refuse."""

import json

import numpy as np
import pytest

from experiments import walking_terrain, walking_tracking
from jumper_warp.policies.folder import save_policy
from jumper_warp.policies.spec import PolicyError
from jumper_warp.registry import make_task
from jumper_warp.utils.errors import InputError
from landing_helpers import still_policy
from support.walks import kicked, sped_up

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    """Folders of still policies by task."""
    folder = tmp_path_factory.mktemp("policies")
    for name in ("velocity-flat", "horizontal-jump"):
        save_policy(folder / name, still_policy(name))
    return folder


def test_robots_that_stand_still_follow_nothing(policies, tmp_path):
    args = walking_tracking.Args(
        policy=str(policies / "velocity-flat"), commands_per_axis=2, num_recorded=0, out=tmp_path, device="cpu"
    )
    values = walking_tracking.main(args)
    figures = json.loads((tmp_path / "metrics.json").read_text())
    assert figures == values and (tmp_path / "tracking.png").is_file()
    for name in ("rmse_vx_m_s", "rmse_vy_m_s", "rmse_yaw_rate_rad_s"):
        assert figures[name] == pytest.approx(0.8, abs=0.02)
    assert (figures["robots"], figures["falls"], figures["median_settling_s"]) == (8, 0, None)
    assert figures["top_ahead_m_s"] == figures["top_turning_rad_s"] == figures["steps_hz"] == 0.0
    assert figures["share_down_FL_FR_BL_BR"] == 1.0 and figures["cost_of_transport"] is None
    assert figures["kicked_fall_rate"] == 0.0


def test_robots_that_stand_still_come_nowhere_on_any_ground(policies, tmp_path):
    args = walking_terrain.Args(
        policy=str(policies / "velocity-flat"), num_robots=3, terrains=("flat", "stairs"), num_recorded=1, out=tmp_path,
        device="cpu",
    )  # fmt: skip
    figures = walking_terrain.main(args)
    assert figures["success_rate_flat"] < 0.02 and figures["success_rate_stairs"] < 0.02
    assert figures["fall_rate_flat"] == 0.0 and (tmp_path / "terrain.png").is_file()
    assert (tmp_path / "stairs.rrd").stat().st_size > 10_000 and (tmp_path / "flat.png").stat().st_size > 10_000


def test_kicks_and_speeds_are_those_of_the_test():
    class Env:
        num_envs, task, step_dt = 16, make_task("velocity-flat"), 1.0 / 60.0

    thrown = kicked(Env, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(thrown.kick, axis=1), 0.5)
    assert thrown.kick_time.min() >= 2.0 and thrown.kick_time.max() <= 4.0
    fast, which = sped_up(Env)
    last = fast.commands[:, -1]
    np.testing.assert_allclose(last[which == 1, 0], -np.linspace(0.3, 4.0, 4))
    np.testing.assert_allclose(last[which == 2, 1], np.linspace(0.3, 2.0, 4))
    assert not last[which == 3, :2].any() and fast.times[-1] < 3.0


def test_policy_of_another_task_and_settings_out_of_range_are_refused(policies, tmp_path):
    with pytest.raises(PolicyError, match="evaluated by velocity"):
        walking_tracking.main(
            walking_tracking.Args(policy=str(policies / "horizontal-jump"), out=tmp_path, device="cpu")
        )
    with pytest.raises(InputError, match="commands_per_axis"):
        walking_tracking.Args(commands_per_axis=1)
    with pytest.raises(InputError, match="speed"):
        walking_terrain.Args(speed=0.9)

"""Walking experiments with a policy that stands still: commands, outputs and refused settings."""

import numpy as np
import pytest

from experiments.walking_terrain import Args, KickedWalks, main
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.policies.policy import save_policy
from jumper_warp.tasks.velocity.cfg import VelocityEvaluation
from landing_helpers import still_policy

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """Folder of a policy that stands still."""
    return str(save_policy(tmp_path_factory.mktemp("policy") / "still", still_policy("velocity-flat")))


def test_standing_policy_has_zero_success_on_terrains(policy, tmp_path):
    args = Args(policy=policy, num_robots=3, terrains=("flat", "stairs"), num_recorded=1, out=tmp_path, device="cpu")
    metrics = main(args)
    assert metrics["flat_walked_fraction_mean"] < 0.02 and metrics["stairs_walked_fraction_mean"] < 0.02
    assert metrics["flat_fall_rate"] == 0.0
    assert (tmp_path / "stairs.rrd").stat().st_size > 10_000 and (tmp_path / "flat.png").stat().st_size > 10_000


def test_kicks_change_the_velocity_of_every_base_by_their_size(policy, tmp_path):
    args = Args(policy=policy, num_robots=3, terrains=("flat",), kick=0.5, num_recorded=0, out=tmp_path, device="cpu")
    run = EvaluationRun.from_args("test", args, VelocityEvaluation)
    env = run.env(3)
    walks = KickedWalks(np.zeros((3, 1, 3)), env.task, 4.0, kick=0.5)
    run.run_episodes(env, walks)
    speed = np.linalg.norm(np.array(walks.velocity)[..., :2], axis=2)  # (steps, robots) [m/s]
    assert speed[:180].max() < 0.1  # a kick changes the step after it
    assert speed[180].min() > 0.3

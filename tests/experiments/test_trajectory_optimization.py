import numpy as np
import pytest
import torch

from experiments import trajectory_optimization as experiment
from experiments.trajectory_optimization import JUMPS, LIMITED, run_ups
from jumper_warp.trajectory.smoothing import penalised

pytestmark = pytest.mark.usefixtures("one_thread")


def test_reported_metrics_equal_replay_of_saved_targets(tmp_path):
    """A short search reports the metrics of a replay of the targets that it wrote."""
    args = experiment.Args(jumps=("highest",), samples=48, effort=0.01, final_iterations=1, out=tmp_path, device="cpu")
    values = experiment.main(args)
    saved = np.load(tmp_path / "highest.npz", allow_pickle=False)
    replay = JUMPS["highest"].replay(saved["targets"])
    assert values["highest_apex_m"] == pytest.approx(replay.apex, abs=1e-6) and replay.apex > 0.4
    assert values["highest_gradients_value"] == values["highest_apex_m"]
    assert values["highest_gradients_reverse_steps"] > 0.0
    assert {"highest.rrd", "highest.png", "trajectories.png"} <= {path.name for path in tmp_path.iterdir()}


def test_replay_measures_paws_lifted_after_touchdown():
    """The first motion jumps, lands and squats; the second one then jumps again."""
    jump = JUMPS["still"]
    knots = jump.make(substeps=8, device="cpu").knots
    x = np.zeros((2, len(knots.at), 4))
    x[:, 2:10], x[:, 10:20], x[:, -12:] = 0.5, -0.4, 0.5
    x[1, -2:] = -0.4
    targets = knots.targets(torch.as_tensor(x.reshape(2, -1))).numpy()
    once, twice = (jump.replay(targets[..., i], device="cpu") for i in range(2))
    assert once.touched == twice.touched == 4 and once.takeoff == twice.takeoff
    assert once.longest_lift < 0.1 < twice.longest_lift and once.highest_lift + 0.02 < twice.highest_lift
    assert once.work == twice.work > 20.0 and once.apex > 0.5


def test_replay_matches_objective_and_constraints_of_problem():
    """Replay and problem agree in distance [m] and largest constraint violation of forward jumps."""
    jump = JUMPS["farthest"]
    made = jump.make(device="cpu", threads=1)
    x = torch.as_tensor(run_ups(made.knots, 32, np.random.default_rng(0)))
    with torch.no_grad():
        values = made.evaluate(x)
    best = penalised(values).argsort()[:4]
    replays = [jump.replay(made.knots.targets(x)[..., i].numpy(), "cpu") for i in best.tolist()]
    flown, violations = -values.objective[best].numpy(), values.constraints[best].amax(1).clamp_min(0.0).numpy()
    assert flown.max() > 1.0 and violations.max() > 0.01
    assert [jump.value(replay) for replay in replays] == pytest.approx(flown, abs=1e-3)
    assert [replay.violation for replay in replays] == pytest.approx(violations, abs=1e-3)


def test_each_limit_changes_only_the_named_setting():
    made = {name: jump.make() for name, jump in LIMITED.items()}
    nominal = JUMPS["farthest"].make()
    kind, kinds = nominal.motors.transversal, {name: problem.motors.transversal for name, problem in made.items()}
    assert kinds["farthest_torque_24_8"].saturation == pytest.approx(24.8)
    assert kinds["farthest_speed"].cutoff_speed == pytest.approx(1.5 * kind.cutoff_speed)
    assert kinds["farthest_speed"].no_load_speed == pytest.approx(1.5 * kind.no_load_speed)
    assert made["farthest_speed"].motors.fade_end == pytest.approx(1.5 * nominal.motors.fade_end)
    others = ("pitch", "stance", "filter", "friction_1_5", "friction_0_6")
    assert {kinds[f"farthest_{name}"] for name in others} == {kind}
    assert made["farthest_filter"].command_filter.horizon < nominal.command_filter.horizon
    assert [made[f"farthest_friction_{name}"].friction for name in ("1_5", "0_6")] == [1.5, 0.6]


def test_run_ups_vary_lean_back_and_take_off():
    made = JUMPS["farthest"].make(device="cpu", threads=1)
    x = run_ups(made.knots, 32, np.random.default_rng(0))
    rows = x.reshape(32, -1, 4)
    assert np.abs(x).max() <= 1.0 and (rows[:, -1] == -1.0).all() and np.ptp(rows[:, 0], axis=0).min() > 0.3
    with torch.no_grad():
        motion = made.motion(torch.as_tensor(x))
    back = -motion.q[:30, :, 0].amin(0).numpy()
    assert np.median(back) > 0.1
    assert motion.takeoff(0.25)[1].float().mean() > 0.5

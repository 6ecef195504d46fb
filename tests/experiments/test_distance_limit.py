import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from experiments import distance_limit as limit
from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.kernels import layout
from jumper_warp.registry import make_task
from support import takeoff_search as jumps
from support.takeoffs import Takeoffs

ARGS = limit.Args(population=8, device="cpu")
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def env():
    return jumps.env_of_limit(jumps.NOMINAL, ARGS.population, ARGS.device)


# ---------------------------------------------------------------- jumps


def test_score_against_hand_numbers(env):
    env.evaluation_reset(np.zeros((8, 4)))
    takeoffs = Takeoffs(env)
    takeoffs.off[:7] = True
    takeoffs.com[:] = takeoffs.start + [0.3, 0.0, 0.0]
    takeoffs.com[:, 2] = takeoffs.landing_height  # 2 x 2.4525 / 9.81 = 0.5 s in the air, 1.3 m
    takeoffs.com_vel[:] = [2.0, 0.0, 2.4525]
    takeoffs.spin[1:] = np.radians(100.0)  # 50 degrees at landing, 20 too many
    takeoffs.bad[2] = True
    assert jumps.score(takeoffs, jumps.NOMINAL)[[0, 1, 2, 7]] == pytest.approx([1.3, 0.3, -0.7, -3.0], abs=1e-4)
    takeoffs.back[:] = 0.15  # 0.1 m too far for the limit of leaning
    assert jumps.score(takeoffs, limit.LIMITS["lean"])[0] == pytest.approx(0.8, abs=1e-4)
    assert jumps.score(takeoffs, limit.LIMITS["pitch"])[1] == pytest.approx(1.3, abs=1e-5)
    apex = takeoffs.landing_height[0] + 2.4525**2 / 19.62
    assert jumps.score(takeoffs, limit.APEX)[0] == pytest.approx(apex, abs=1e-5)


def test_policy_takes_off_as_its_own_touchdown_says(tmp_path):
    """The flight told for the policy is where its base comes down, but for posture and height."""
    run = EvaluationRun.of("distance_limit", EvaluationArgs(record=0, out=tmp_path, device="cpu"))
    takeoffs, landings, actions = jumps.fly_policy(run)
    assert (takeoffs.flight > 1.2).all() and landings.success.all()
    assert takeoffs.touchdown == pytest.approx(takeoffs.flight, abs=0.15)
    assert takeoffs.touchdown == pytest.approx(landings.touchdown[:, 0, 0], abs=1e-6)
    assert 0.4 < len(actions) / 60.0 < 2.0 and actions.shape[1] == 4


# ---------------------------------------------------------------- limits


def test_each_limit_changes_what_it_names():
    task = make_task("horizontal-jump")
    kinds = {name: row.task(task).motors.transversal for name, row in limit.LIMITS.items()}
    assert kinds["torque_x_1_1"].saturation == pytest.approx(19.8)
    assert kinds["torque_24_8"].saturation == pytest.approx(24.8)
    assert kinds["speed"].cutoff_speed == pytest.approx(1.5 * kinds["pitch"].cutoff_speed)
    assert kinds["speed"].no_load_speed == pytest.approx(1.5 * kinds["pitch"].no_load_speed)
    assert {kinds[name] for name in ("knees", "friction_1_5", "stance", "filter", "mass")} == {task.motors.transversal}
    assert limit.LIMITS["filter"].task(task).command_filter.horizon < task.command_filter.horizon
    terms = jumps.env_of_limit(jumps.NOMINAL, ARGS.population, ARGS.device).task.terminations
    assert [term.name for term in terms] == ["success", "came_apart", "low_base", "left_stance", "collided"]
    names = [
        term.name for term in jumps.env_of_limit(limit.LIMITS["stance"], ARGS.population, ARGS.device).task.terminations
    ]
    assert names == ["success", "came_apart", "low_base", "collided"]


def test_limits_of_the_model_reach_the_solver():
    changed = jumps.env_of_limit(jumps.NOMINAL, ARGS.population, ARGS.device)
    table = changed.sim.physics.dynamics.robot.table
    before = table.numpy()[:, 0].copy()
    mass = [layout.BASE, layout.HOUSING]
    for name, rows, ratio in (("mass", mass, 0.9), ("friction_0_6", [layout.MU_STATIC], 0.6 / 0.85)):
        limit.LIMITS[name].model(changed)
        assert table.numpy()[rows, 0] == pytest.approx(ratio * before[rows], rel=1e-5), name
    assert before[layout.MU_DYNAMIC] == pytest.approx(limit.FRICTION)
    limit.LIMITS["knees"].model(changed)
    assert before[layout.KNEE_DAMPING] == pytest.approx(0.1)
    assert table.numpy()[layout.KNEE_DAMPING, 0] == 0.0


# ---------------------------------------------------------------- search


def test_actions_pass_through_their_knots_and_stay_within_bounds():
    knots = np.zeros((1, len(jumps.KNOTS), 4))
    knots[0, :, 0] = np.linspace(0.0, 1.0, len(jumps.KNOTS))
    knots[0, 1, 2] = 3.0
    actions = jumps.actions_of(knots.reshape(1, -1))[0]
    assert actions[jumps.KNOTS.astype(int), 0] == pytest.approx(knots[0, :, 0])
    assert actions[4, 2] == pytest.approx(0.5) and actions.max() == 1.0
    again = jumps.actions_of(jumps.knots_of(actions)[None])[0]
    np.testing.assert_allclose(again, actions, atol=1e-9)


def test_search_gets_farther_and_keeps_where_it_began(env):
    actions = np.full((1, jumps.TICKS, 4), 0.9)
    actions[:, 30:, :2], actions[:, 32:, 2:] = -1.0, -1.0
    begin = jumps.knots_of(actions[0])
    first = float(jumps.score(jumps.fly_best(env, begin), jumps.NOMINAL)[0])
    best, value = jumps.search(env, jumps.NOMINAL, begin, 0.1, 30, seed=0)
    assert value > first + 1.0 and np.abs(best).max() <= 1.0
    assert jumps.score(jumps.fly_best(env, best), jumps.NOMINAL)[0] == pytest.approx(value, abs=1e-5)
    assert jumps.search(env, jumps.NOMINAL, best, 0.8, 1, seed=0)[1] >= value - 1e-6


# ---------------------------------------------------------------- the experiment


def test_experiment_reports_policy_nominal_and_changed_limit(tmp_path):
    args = replace(ARGS, limits=("torque_24_8",), generations=2, further=2, squats=1, out=tmp_path)
    values = limit.main(args)
    assert values == json.loads((tmp_path / "metrics.json").read_text())
    assert values["nominal_flight_m"] > 0.8 and values["nominal_gain_m"] == 0.0
    assert values["torque_24_8_gain_m"] == pytest.approx(values["torque_24_8_flight_m"] - values["nominal_flight_m"])
    assert values["policy_2_gain_m"] == pytest.approx(values["policy_2_flight_m"] - values["nominal_flight_m"])
    assert "nominal_landing_capture_m" in values and "torque_24_8_landing_capture_m" not in values
    assert len(values["caught"]) == len(jumps.POLICY_GOALS)
    assert np.load(tmp_path / "actions.npy").shape == (jumps.TICKS, 4)
    assert (tmp_path / "distance_limit.png").stat().st_size > 1000


def test_unknown_limit_is_refused_in_one_line(capsys):
    with pytest.raises(SystemExit):
        run_command(lambda: limit.Args(limits=("wings",)))
    assert capsys.readouterr().err.startswith("jumper: no limit 'wings'; there are torque_x_1_1")


def test_missing_package_is_told_with_its_remedy(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(SystemExit):
        run_command(lambda: limit.main(ARGS))
    assert capsys.readouterr().err == 'jumper: this experiment needs the package cma: pip install "cma>=4"\n'

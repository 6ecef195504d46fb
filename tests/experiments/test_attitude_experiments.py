"""Experiments of turns in flight at a tiny size, with a barely trained policy."""

import pytest

from experiments import attitude, flight_attitude
from jumper_warp.cli.main import main as cli
from jumper_warp.utils.output import read_values

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Folder of a run of `jumper train attitude` with one iteration."""
    root = tmp_path_factory.mktemp("logs")
    args = "--num-envs 8 --max-iterations 1 --ppo.num-steps 4 --ppo.minibatches 1 --ppo.hidden 8 --device cpu"
    cli(["train", "attitude", *args.split(), "--log-root", str(root)])
    return next((root / "attitude").iterdir())


def test_turns_about_all_axes_write_metrics_plot_and_recording(run, tmp_path):
    args = attitude.Args(
        policy=str(run), num_turns=6, seconds=0.2, num_recorded=1, refine=2, out=tmp_path, device="cpu"
    )
    values = attitude.main(args)
    assert read_values(tmp_path) == values
    assert values["physics_step_s"] == pytest.approx(1.0 / 960.0)
    assert values["settled_without_collision_rate"] == 0.0 and 80.0 < values["error_at_end_mean_deg"] < 100.0
    assert 0.0 < values["angular_momentum_max_nm_s"] < 1.0e-5
    assert (tmp_path / "turns.png").is_file() and (tmp_path / "turn.rrd").stat().st_size > 10_000


def test_flights_with_and_without_turning_have_the_same_takeoffs(run, tmp_path):
    args = flight_attitude.Args(
        policy=str(run), num_flights=2, max_leg_delay=10.0, num_recorded=1, out=tmp_path, device="cpu"
    )
    values = flight_attitude.main(args)
    assert read_values(tmp_path) == values
    assert values["apex_mean_m"] > 2.5 and values["takeoff_spin_mean_rad_s"] > 0.1
    takeoff = "takeoff_spin_mean_rad_s"
    assert values[f"without_turning_{takeoff}"] == pytest.approx(values[takeoff])
    assert (tmp_path / "flights.png").is_file() and (tmp_path / "turning.rrd").stat().st_size > 10_000


def test_policy_takes_off_to_commanded_heights_and_lands(run, tmp_path):
    args = flight_attitude.Args(
        policy=str(run), takeoff="policy", landing_policy="mars_vertical_jump", height_range=(1.5, 2.0), num_flights=2,
        num_recorded=0, out=tmp_path, device="cpu",
    )  # fmt: skip
    values = flight_attitude.main(args)
    held = {name.removeprefix("without_turning_"): value for name, value in values.items()}
    assert held["landed_upright_rate"] == 1.0 and held["apex_error_abs_mean_m"] < 0.1
    assert values["apex_mean_m"] == pytest.approx(1.75, abs=0.2) and "late_ms" not in values
    assert values["angular_momentum_change_in_flight_max_nm_s"] < 1.0e-4
    assert 0.0 < held["touchdown_turn_mean_deg"] <= held["touchdown_turn_max_deg"] < 20.0

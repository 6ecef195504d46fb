"""Open-loop jump of a robot with an overlay."""

import numpy as np
import pytest

from experiments import open_loop_jump
from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.sim.simulation import Simulation
from jumper_warp.utils.output import read_values
from support.open_loop import simulate_jump


def test_heavier_robot_jumps_lower_without_hardware_comparison(tmp_path):
    overlay = RobotOverlay({"base_mass": (10.0,)}, source="6.43 kg, and a load")
    overlay.save(tmp_path / "heavy.json")
    args = open_loop_jump.Args(robot=tmp_path / "heavy.json", out=tmp_path, device="cpu")
    values = open_loop_jump.main(args)
    assert values == read_values(tmp_path)
    assert 0.9 < values["apex_height_m"] < 1.02  # 1.075 m without
    assert values["hardware_apex_height_m"] is None and values["robot"].endswith("heavy.json")
    assert (tmp_path / "jump.png").stat().st_size > 10_000


@pytest.mark.parametrize("saturation", [None, 0.85])
def test_torque_limit_is_that_of_the_robot(tmp_path, monkeypatch, capsys, saturation):
    titles = []
    monkeypatch.setattr(open_loop_jump, "plot_trace", lambda path, trace, title, hardware: titles.append(title))
    values = {"base_mass": (6.43,)} | ({} if saturation is None else {"saturation": 12 * (saturation,)})
    RobotOverlay(values).save(tmp_path / "robot.json")
    metrics = open_loop_jump.main(open_loop_jump.Args(robot=tmp_path / "robot.json", out=tmp_path, device="cpu"))
    limit = 18.0 * (saturation or 1.0)  # [N m]
    assert metrics["torque_limit_nm"] == pytest.approx(limit) and metrics["peak_torque_nm"] <= limit + 1e-4
    for text in (titles[0], " ".join(capsys.readouterr().out.split())):
        assert f"{limit:g} N m" in text and (saturation is None) == ("18 N m" in text)


def test_recorded_paw_forces_are_the_peaks_of_the_trace():
    sim = Simulation(1, motors=jumping_motors(18.0), command_filter=vertical_jump_filter(), visuals=False, device="cpu")
    trace, recorder = simulate_jump(sim, {})
    shown = recorder.recording()
    peaks = np.linalg.norm(trace.force, axis=2).reshape(-1, sim.substeps, 4).max(axis=1)
    np.testing.assert_allclose(np.linalg.norm(shown.contact_forces[:, 0], axis=2), peaks, rtol=1e-5)
    np.testing.assert_allclose(shown.series["peak paw force/FL [N]"], peaks[:, 0], rtol=1e-5)

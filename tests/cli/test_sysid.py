"""The command `jumper sysid`, from planned motions to an overlay that the other commands take."""

import json
from dataclasses import replace

import numpy as np
import pytest

from jumper_warp.cli.main import main
from jumper_warp.identification.motions import load_motion
from jumper_warp.robot.overlay import RobotOverlay, load_overlay

PARAMS = ["--params", "latency,offsets"]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Folder with the overlay truth.json (sensor offsets, latency of 3 ms) and its robot's recorded `motions`."""
    folder = tmp_path_factory.mktemp("sysid")
    truth = RobotOverlay({"offset": tuple(np.radians(np.linspace(-1.0, 1.0, 12))), "latency": (0.003,)})
    truth.save(folder / "truth.json")
    flags = ["--num-candidates", "1", "--seconds", "0.5", "--robot", str(folder / "truth.json")]
    main(["sysid", "excite", *PARAMS, *flags, "--out", str(folder / "motions")])
    return folder


def test_excite_writes_motions_and_expected_accuracy(recorded):
    files = sorted((recorded / "motions").glob("*.npz"))
    assert [file.stem for file in files] == ["0_hung_chirp", "1_hung_chirp", "2_standing_chirp", "3_small_jump"]
    assert [load_motion(file).base for file in files] == ["fixed", "fixed", "free", "free"]
    plan = json.loads((recorded / "motions" / "excite.json").read_text())
    assert np.all(np.diff(plan["gain_nat"]) > 0.0)
    assert plan["mass_kg"] == pytest.approx(14.5)  # of the described robot
    assert plan["parameters"]["latency"]["expected_deviation"] < 2.0e-4  # [s]
    assert plan["parameters"]["offset/FL_outer"]["of_prior"] < 0.2  # expected over prior standard deviation


def test_sysid_writes_overlay_report_and_plots(recorded, capsys):
    out = recorded / "identified"
    main(["sysid", str(recorded / "motions"), *PARAMS, "--out", str(out)])
    overlay, truth = load_overlay(out / "identified.json"), load_overlay(recorded / "truth.json")
    assert overlay.values["latency"][0] == pytest.approx(0.003, abs=1.0e-4)  # [s]
    np.testing.assert_allclose(overlay.values["offset"], truth.values["offset"], atol=np.radians(0.25))
    low, high = overlay.randomization["latency"]
    assert 2.8 < low < 3.0 < high < 3.2  # [ms]
    report = json.loads((out / "report.json").read_text())
    assert 0.9 < report["chi2"] < 1.1 and report["nominal_chi2"] > 10.0
    plots = sorted(path.stem for path in out.glob("*.png"))
    motions = ["0_0_hung_chirp", "1_1_hung_chirp", "2_2_standing_chirp", "3_3_small_jump"]
    assert plots == [*(f"motion_{name}" for name in motions), "parameters", "progress"]
    printed = capsys.readouterr()
    assert "χ²" in printed.out and "warning" not in printed.out and report["doubts"] == []
    assert "starts agree" in printed.out and report["consistent"] and "not consistent" not in printed.err


def test_prints_warning_of_a_wrong_mass(recorded, capsys):
    args = ["--params", "masses", "--mass", "20", "--mass-std", "0.5", "--out", str(recorded / "heavy")]
    with pytest.raises(SystemExit) as end:
        main(["sysid", str(recorded / "motions" / "2_standing_chirp.npz"), *args])
    assert end.value.code == 3
    assert "warning: total mass is given as 20 ± 0.5 but found as" in capsys.readouterr().out


def test_inconsistent_fit_exits_with_3_and_renames_the_overlay(recorded, capsys):
    motion = load_motion(recorded / "motions" / "0_hung_chirp.npz")
    out, scaled = recorded / "again", recorded / "scaled.npz"
    scaled_motion = replace(motion, angle=1.02 * motion.angle)  # which no latency explains
    scaled_motion.save(scaled)
    out.mkdir()
    (out / "identified.json").write_text("of an earlier fit")
    with pytest.raises(SystemExit) as end:
        main(["sysid", str(scaled), *PARAMS, "--out", str(out)])
    assert end.value.code == 3
    line = capsys.readouterr().err.strip()
    assert line.startswith("jumper: not consistent: scaled angle χ² ") and line.endswith("inconsistent.json")
    assert not (out / "identified.json").exists()
    assert "the fit is not consistent: scaled angle" in load_overlay(out / "inconsistent.json").source
    report = json.loads((out / "report.json").read_text())
    assert not report["consistent"] and report["starts_agree"]
    failed = [test for test in report["tests"] if not test["passed"]]
    assert all(test["chi2"] > test["limit"] for test in failed) and failed[0]["channel"] == "angle"


def test_refuses_a_folder_of_motions_given_twice(recorded, capsys):
    with pytest.raises(SystemExit) as end:
        main(["sysid", "fit", str(recorded / "motions"), str(recorded / "motions"), *PARAMS])
    assert end.value.code == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "motions 1 (0_hung_chirp) and 5 (0_hung_chirp) are the same recording: give it once" in error


def test_refuses_an_overlay_as_the_robot_of_a_fit(recorded, capsys):
    with pytest.raises(SystemExit) as end:
        main(["sysid", "fit", str(recorded / "motions"), *PARAMS, "--robot", str(recorded / "truth.json")])
    assert end.value.code == 2 and "give the robot's folder, not the overlay" in capsys.readouterr().err

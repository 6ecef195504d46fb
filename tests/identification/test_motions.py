"""Reading and writing of recorded motions, and refusal of bad files."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from jumper_warp.identification.motions import RecordedMotion, load_motion
from jumper_warp.identification.residuals import check_signs
from jumper_warp.robot.description import MOTOR_JOINTS
from jumper_warp.utils.errors import InputError

ROWS = 12  # rows of a motion
TORQUE_CONSTANT = 1.5  # [N m/A] of the motors in tables


def random_motion():
    """Return a motion of random values at 240 Hz, with angles in every other row, without rates and positions."""
    rng = np.random.default_rng(0)
    angle = rng.normal(size=(ROWS, 12))
    angle[1::2] = math.nan
    quaternion = rng.normal(size=(ROWS, 4))
    return RecordedMotion(
        name="walk",
        time=np.arange(ROWS) / 240.0,
        target=rng.normal(size=(ROWS, 12)),
        angle=angle,
        torque=rng.normal(size=(ROWS, 12)),
        quaternion=quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        base="fixed",
        torque_limit=12.0,
    )


def table_of(motion):
    """Return the columns (ROWS,) of a motion by name: time in ms, angles in degrees, targets in rad, currents."""
    columns = {"time [ms]": 1000.0 * motion.time}
    for i, joint in enumerate(MOTOR_JOINTS):
        columns[f"target/{joint}"] = motion.target[:, i]
        columns[f"angle/{joint} [deg]"] = np.degrees(motion.angle[:, i])
        columns[f"current/{joint} [A]"] = motion.torque[:, i] / TORQUE_CONSTANT
    for i, axis in enumerate("xyzw"):
        columns[f"quaternion/{axis}"] = motion.quaternion[:, i]
    return columns


def write_csv(path, columns, settings=None):
    """Write columns by name as CSV, NaN as an empty cell, and settings as the JSON file next to it."""
    rows = [",".join(columns)]
    for row in zip(*columns.values(), strict=True):
        rows.append(",".join("" if math.isnan(x) else repr(float(x)) for x in row))
    path.write_text("\n".join(rows) + "\n")
    if settings is not None:
        path.with_suffix(".json").write_text(json.dumps(settings))


def assert_same(loaded, motion):
    """Assert that a loaded motion equals a `random_motion` in values, missing channels, name and settings."""
    for name in ("time", "target", "angle", "torque", "quaternion"):
        np.testing.assert_allclose(getattr(loaded, name), getattr(motion, name), atol=1e-12)
    assert loaded.rate is None and loaded.position is None
    assert (loaded.name, loaded.base, loaded.torque_limit, loaded.gains) == ("walk", "fixed", 12.0, "jumping")


def test_load_motion_reads_npz_and_csv_and_overrides_settings(tmp_path):
    motion = random_motion()
    motion.save(tmp_path / "walk.npz")
    assert_same(load_motion(tmp_path / "walk.npz"), motion)
    columns = table_of(motion)
    write_csv(tmp_path / "walk.csv", columns, {"base": "fixed", "torque_limit": 12.0})
    assert_same(load_motion(tmp_path / "walk.csv", torque_constant=TORQUE_CONSTANT), motion)
    assert load_motion(tmp_path / "walk.csv", torque_constant=TORQUE_CONSTANT, base="free").base == "free"


@pytest.mark.parametrize(
    ("change", "message"),  # change: of the columns c by name
    [
        (lambda c: {k: v for k, v in c.items() if k != "target/BL_inner"}, "target/BL_inner is missing"),
        (lambda c: c | {"target/FL_outer": 40.0 + c["target/FL_outer"]}, "give its unit"),
        (lambda c: c | {"time [ms]": c["time [ms]"][::-1]}, "time must be finite and rise, it does not in row 1"),
    ],
)
def test_load_motion_refuses_a_bad_table_in_one_line(tmp_path, change, message):
    write_csv(tmp_path / "walk.csv", change(table_of(random_motion())))
    with pytest.raises(InputError, match=message) as error:
        load_motion(tmp_path / "walk.csv", torque_constant=TORQUE_CONSTANT)
    assert "\n" not in str(error.value)


def test_check_signs_names_motors_with_inverted_angles():
    motion = random_motion()
    target = np.tile([0.05, 0.8, 0.8], (ROWS, 4)) + 0.05 * motion.target  # [rad] around a squat
    lag = np.tile([-0.1, 0.2, -0.2], 4)  # [rad]
    angle = target + lag + np.where(np.isfinite(motion.angle), 0.0, math.nan)
    right = replace(motion, target=target, angle=angle)
    check_signs(right)
    sign = np.ones(12)
    sign[[1, 11]] = -1.0  # FL_outer, BR_inner
    for wrong in (replace(right, angle=sign * angle), replace(right, target=sign * target)):
        with pytest.raises(InputError, match="motion walk: angles of FL_outer, BR_inner have the sign opposite"):
            check_signs(wrong)
    check_signs(replace(right, angle=math.nan * angle))  # nothing measured


def test_times_in_nanoseconds_need_their_unit(tmp_path):
    columns = table_of(random_motion())
    milliseconds = columns.pop("time [ms]")
    write_csv(tmp_path / "walk.csv", {"time": 1.0e6 * milliseconds, **columns})
    with pytest.raises(InputError, match=r"time rises by .* s a row: give its unit"):
        load_motion(tmp_path / "walk.csv", torque_constant=TORQUE_CONSTANT)
    write_csv(tmp_path / "walk.csv", {"time [ns]": 1.0e6 * milliseconds, **columns})
    motion = load_motion(tmp_path / "walk.csv", torque_constant=TORQUE_CONSTANT)
    np.testing.assert_allclose(motion.time, 1.0e-3 * milliseconds, atol=1.0e-12)

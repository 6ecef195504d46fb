"""Identification of motor constants from a synthetic test bench with known constants."""

import dataclasses
import math
import re

import numpy as np
import pytest

from jumper_warp.identification.actuators import (
    COLUMNS,
    Bench,
    characterise_motor,
    described_constants,
    load_bench,
    torque_law,
)
from jumper_warp.kernels.actuation.motors import MotorParams, motor_torque
from jumper_warp.utils.errors import InputError
from synthetic_bench import synthetic_bench

TRUTH = {  # constants of the bench's motor, names and units as in `PRIORS`
    "saturation": 15.0, "peak": 22.0, "cutoff_speed": 21.0, "no_load_speed": 37.0, "fade_start": 33.0, "fade_end": 42.0,
    "friction": 0.15, "latency": 4.0e-3, "time_constant": 2.5e-3,
}  # fmt: skip


def test_torque_law_without_friction_matches_the_kernels_motor_torque():
    motor = MotorParams()
    for name in ("saturation", "peak", "cutoff_speed", "no_load_speed", "fade_start", "fade_end"):
        setattr(motor, name, TRUTH[name])
    motor.kp, motor.kd, motor.offset = 1.0, 0.0, 0.0  # so that the torque [N m] is the target minus the angle
    for command in (-30.0, -3.0, 3.0, 30.0):  # [N m]
        for speed in np.linspace(-45.0, 45.0, 31):  # [rad/s]
            expected = motor_torque(command, 0.0, float(speed), motor)
            torque = torque_law(TRUTH | {"friction": 0.0}, np.array([command]), np.array([speed]))[0]
            assert torque == pytest.approx(expected, abs=1e-4)  # [N m]


def test_motor_constants_are_identified_within_twice_their_intervals():
    actuator = characterise_motor(synthetic_bench(TRUTH, np.random.default_rng(0)))
    assert 0.9 < actuator.chi2 < 1.1
    # saturation lies below the peak torque, so that only the slope of the torque-speed line is determined
    assert set(actuator.open) == {"peak", "cutoff_speed"}
    slope, expected = (c["peak"] / (c["no_load_speed"] - c["cutoff_speed"]) for c in (actuator.constants, TRUTH))
    assert slope == pytest.approx(expected, rel=0.05)
    for name, (value, low, high, _) in actuator.rows().items():
        if name not in actuator.open:
            assert value == pytest.approx(TRUTH[name], rel=0.06), name
        middle, half_width = 0.5 * math.log(low * high), 0.5 * math.log(high / low)
        assert abs(math.log(TRUTH[name]) - middle) < 2.0 * half_width, name


def test_constants_beyond_the_tested_speeds_stay_open():
    whole = synthetic_bench(TRUTH, np.random.default_rng(0))
    slow = np.abs(whole.speed) < 10.0  # [rad/s]; the cutoff speed is 21
    bench = Bench(*(getattr(whole, name)[slow] for name in COLUMNS))
    actuator = characterise_motor(bench)
    assert {"no_load_speed", "cutoff_speed", "fade_start", "fade_end", "peak"} <= set(actuator.open)
    assert not {"saturation", "friction", "latency"} & set(actuator.open)
    prior_mean = described_constants("transversal")["no_load_speed"]
    assert actuator.constants["no_load_speed"] == pytest.approx(prior_mean, rel=0.1)


@pytest.mark.parametrize(
    ("torque", "reason"),
    [
        (lambda x: -x, "χ²"),
        (lambda x: 0.0 * x, r"(peak|saturation) .* standard deviations"),
        (lambda x: 1.3 * x + 5.0, "χ²"),
    ],
)
def test_a_wrong_sign_a_dead_sensor_and_an_offset_are_not_consistent(torque, reason):
    bench = synthetic_bench(TRUTH, np.random.default_rng(0))
    assert not characterise_motor(bench).inconsistency
    wrong = characterise_motor(dataclasses.replace(bench, torque=torque(bench.torque)))
    assert re.search(reason, wrong.inconsistency) and not wrong.to_json()["consistent"]


def test_data_that_identifies_nothing_is_refused():
    bench = synthetic_bench(TRUTH, np.random.default_rng(0))
    with pytest.raises(InputError, match="identifies none"):
        characterise_motor(bench, torque_noise=100.0)


def test_load_bench_reads_csv_and_refuses_bad_files(tmp_path):
    bench, file = synthetic_bench(TRUTH), tmp_path / "bench.csv"
    rows = zip(*(getattr(bench, name) for name in COLUMNS), strict=True)
    lines = [",".join(COLUMNS), *(",".join(map(str, row)) for row in rows)]
    file.write_text("\n".join([*lines, ""]))
    np.testing.assert_allclose(load_bench(file).torque, bench.torque)
    for old, new, message in (  # a row: test, time [s], command [N m], speed [rad/s], torque [N m]
        ("torque", "moment", "column torque is missing"),
        (lines[5], "1,nan,2,3,4", "time is not finite"),
        (lines[5], "1,two,2,3,4", "every row must hold 5 numbers"),
        (lines[5], "0,0.4,2,3000,4", "is it in rpm"),
    ):
        file.write_text("\n".join([*lines, ""]).replace(old, new, 1))
        with pytest.raises(InputError, match=message):
            load_bench(file)

"""Identification of motor constants from a synthetic test bench with known constants."""

import math

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

TRUTH = {
    "saturation": 15.0, "peak": 22.0, "cutoff_speed": 21.0, "no_load_speed": 37.0, "fade_start": 33.0, "fade_end": 42.0,
    "friction": 0.15, "latency": 4.0e-3, "time_constant": 2.5e-3,
}  # fmt: skip


def test_torque_law_matches_the_simulated_motor():
    motor = MotorParams()
    for name in ("saturation", "peak", "cutoff_speed", "no_load_speed", "fade_start", "fade_end"):
        setattr(motor, name, TRUTH[name])
    motor.kp, motor.kd, motor.offset = 1.0, 0.0, 0.0
    for command in (-30.0, -3.0, 3.0, 30.0):
        for speed in np.linspace(-45.0, 45.0, 31):
            expected = motor_torque(command, 0.0, float(speed), motor)
            torque = torque_law(TRUTH | {"friction": 0.0}, np.array([command]), np.array([speed]))[0]
            assert torque == pytest.approx(expected, abs=1e-4)


def test_motor_constants_are_identified_within_their_intervals():
    actuator = characterise_motor(synthetic_bench(TRUTH, np.random.default_rng(0)))
    assert 0.9 < actuator.chi2 < 1.1
    # below the peak torque only the slope of the curve is determined
    assert set(actuator.open) == {"peak", "cutoff_speed"}
    slope, expected = (c["peak"] / (c["no_load_speed"] - c["cutoff_speed"]) for c in (actuator.constants, TRUTH))
    assert slope == pytest.approx(expected, rel=0.05)
    for name, (value, low, high, _) in actuator.rows().items():
        if name not in actuator.open:
            assert value == pytest.approx(TRUTH[name], rel=0.06), name
        middle, reach = 0.5 * math.log(low * high), 0.5 * math.log(high / low)
        assert abs(math.log(TRUTH[name]) - middle) < 2.0 * reach, name


def test_constants_beyond_the_tested_speeds_stay_open():
    whole = synthetic_bench(TRUTH, np.random.default_rng(0))
    slow = np.abs(whole.speed) < 10.0
    bench = Bench(*(getattr(whole, name)[slow] for name in COLUMNS))
    actuator = characterise_motor(bench)
    assert {"no_load_speed", "cutoff_speed", "fade_start", "fade_end", "peak"} <= set(actuator.open)
    assert not {"saturation", "friction", "latency"} & set(actuator.open)
    described = described_constants("transversal")["no_load_speed"]
    assert actuator.constants["no_load_speed"] == pytest.approx(described, rel=0.1)


def test_load_bench_reads_csv_and_refuses_bad_files(tmp_path):
    bench = synthetic_bench(TRUTH)
    file = tmp_path / "bench.csv"
    rows = zip(*(getattr(bench, name) for name in COLUMNS), strict=True)
    lines = [",".join(COLUMNS), *(",".join(map(str, row)) for row in rows)]
    file.write_text("\n".join(lines))
    np.testing.assert_allclose(load_bench(file).torque, bench.torque)
    for change, words in (
        (lambda text: text.replace("torque", "moment", 1), "column torque is missing"),
        (lambda text: text.replace(lines[5], "1,nan,2,3,4"), "time is not finite"),
        (lambda text: text.replace(lines[5], "1,two,2,3,4"), "every row must hold 5 numbers"),
        (lambda text: text.replace(lines[5], "0,0.4,2,3000,4"), "is it in rpm"),
    ):
        file.write_text(change("\n".join(lines)))
        with pytest.raises(InputError, match=words):
            load_bench(file)

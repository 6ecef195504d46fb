"""Synthetic measurements of motors whose constants are known."""

from collections.abc import Mapping

import numpy as np

from jumper_warp.identification.actuators import Bench, bench_torque


def synthetic_bench(
    constants: Mapping[str, float],
    rng: np.random.Generator | None = None,
    torque_noise: float = 0.1,
    rate: float = 2000.0,
) -> Bench:
    """Return a synthetic bench log of a motor: four speed sweeps, then three command steps at standstill.

    Sweeps: commands 0.3, 5, 40, -40 N m at speeds up to +- 1.2 fade_end [rad/s], 10 rows/s. Steps: 2, 8, -8 N m for
    50 ms, `rate` [Hz]. constants: by name, as `bench_torque` requires. rng: of Gaussian torque noise of standard
    deviation torque_noise [N m]; None: no noise.
    """
    columns: list[np.ndarray] = []
    test = 0
    for command in (0.3, 5.0, 40.0, -40.0):
        speed = np.linspace(-1.2, 1.2, 121) * constants["fade_end"]
        time = 0.1 * np.arange(len(speed))
        columns.append(np.stack([np.full(len(speed), test), time, np.full(len(speed), command), speed, 0.0 * speed]))
        test += 1
    for size in (2.0, 8.0, -8.0):
        time = np.arange(round(0.12 * rate)) / rate
        command = np.where((time > 0.02) & (time < 0.07), size, 0.0)
        columns.append(np.stack([np.full(len(time), test), time, command, 0.0 * time, 0.0 * time]))
        test += 1
    bench = Bench(*np.concatenate(columns, axis=1))
    torque = bench_torque(constants, bench)
    if rng is not None:
        torque = torque + torque_noise * rng.normal(size=len(torque))
    return Bench(bench.test, bench.time, bench.command, bench.speed, torque)

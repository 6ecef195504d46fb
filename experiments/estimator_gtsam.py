"""How large are the errors of gtsam's LeggedInvariantEKF on the readings that `estimator_errors.py --save` wrote?

    python experiments/estimator_errors.py --policy vertical_jump --num-motions 16 --num-draws 2 --save readings.npz
    python experiments/estimator_gtsam.py readings.npz

It needs NumPy and gtsam 4.3 alone. The filter of gtsam has fixed IMU biases and one foothold noise; the script tries
several of those, and prints errors and the ratio of ours to them in the compared ticks. Contacts are those that our
filter detects.
"""

from __future__ import annotations

import sys
from typing import Any

import gtsam  # pyright: ignore[reportMissingImports] not a dependency
import numpy as np

FEET = ("FL", "FR", "BL", "BR")
FOOTHOLD_NOISES = (0.02, 0.1, 0.3, 1.0)  # [m/√s]
CONTACT_NOISE = 2.0e-3  # [m]


def parameters(data: Any, robot: int, foothold: float) -> gtsam.LeggedEstimatorParams:
    """Return the filter's settings: our noise densities, and the gyro's bias at rest."""
    params = gtsam.LeggedEstimatorParams()
    preintegration = gtsam.PreintegrationParams.MakeSharedU(9.81)
    preintegration.setGyroscopeCovariance(np.eye(3) * float(data["gyro_noise"]) ** 2)
    preintegration.setAccelerometerCovariance(np.eye(3) * float(data["accel_noise"]) ** 2)
    preintegration.setIntegrationCovariance(np.eye(3) * 1.0e-10)
    params.preintegrationParams = preintegration
    params.body_P_imu = gtsam.Pose3()
    params.imuBias = gtsam.imuBias.ConstantBias(np.zeros(3), data["start_gyro"][robot])
    params.contactCovariance = np.eye(3) * CONTACT_NOISE**2
    params.footholdProcessSigma = foothold
    params.footholdInitSigma = 0.5
    return params


def run(data: Any, robot: int, foothold: float) -> np.ndarray:
    """Return the errors of a robot, (ticks, 3): velocity [m/s] in the body frame, height [m], tilt [deg]."""
    rot, pos, feet = data["start_rot"][robot], data["start_pos"][robot], data["ankle"][:, robot]
    state = gtsam.NavState(gtsam.Rot3(rot), pos, np.zeros(3))
    footholds = pos[:, None] + rot @ feet[0].T
    sigma = np.array([0.01, 0.01, 1.0e-4, 1.0e-4, 1.0e-4, 5.0e-3, 0.01, 0.01, 0.01, *[0.01] * 12])
    filtered = gtsam.LeggedInvariantEKF(
        state, footholds, np.diag(sigma**2), parameters(data, robot, foothold), list(FEET)
    )
    held = np.ones(4, dtype=bool)
    errors = np.zeros((len(feet), 3))
    for tick, contact in enumerate(data["contact"][:, robot]):
        filtered.predict(data["gyro"][tick, robot], data["accel"][tick, robot], float(data["dt"]))
        measurements = []
        for leg in np.flatnonzero(contact):
            measurement = gtsam.ContactMeasurement()
            measurement.foot = int(leg)
            measurement.bodyPoint = feet[tick, leg]
            measurement.touchdown = bool(not held[leg])
            measurements.append(measurement)
        filtered.processContacts(measurements)
        held = contact
        pose = filtered.estimate()
        found = pose.rotation().matrix()
        true = data["true_rot"][tick, robot]
        velocity = found.T @ pose.x(1) - true.T @ data["true_vel"][tick, robot]
        tilt = np.rad2deg(np.arccos(np.clip(found[2] @ true[2], -1.0, 1.0)))
        errors[tick] = np.linalg.norm(velocity), pose.x(0)[2] - data["true_pos"][tick, robot, 2], tilt
    return errors


def main(path: str) -> None:
    """Print RMS errors of both filters, and ours divided by gtsam's."""
    data = dict(np.load(path))
    rows, columns = data["rows"], data["columns"]  # compared ticks and robots
    ours = np.sqrt((data["ours"][rows, columns] ** 2).mean(0))
    print("filter           velocity m/s  height m  tilt deg")
    print("ours             ", ours)
    for foothold in FOOTHOLD_NOISES:
        errors = np.stack([run(data, robot, foothold) for robot in range(data["gyro"].shape[1])], axis=1)
        theirs = np.sqrt((errors[rows, columns] ** 2).mean(0))
        print(f"gtsam, feet {foothold:4}", theirs, "ours / gtsam", ours / theirs)


if __name__ == "__main__":
    main(sys.argv[1])

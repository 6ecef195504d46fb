"""Faults of simulated buses."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class BusFaults:
    """Faults of buses, motors and sensors, which may change at any time."""

    drop: float = 0.0  # Probability that a frame is lost
    corrupt: float = 0.0  # Probability that a frame arrives as an error frame
    delay: float = 0.0  # Probability that a motor gets its command a tick late
    temperature: float = 35.0  # [°C] Of the motors
    error_code: int = 0  # Of the first motor's replies
    motor_own_id: bool = False  # Motors reply under their own id, as some firmware
    gyro_noise: float = 0.0  # [rad/s] Standard deviation in each reading
    accel_noise: float = 0.0  # [m/s^2] Standard deviation in each reading
    seed: int = 0  # Of noise, and of lost, corrupt and late frames

"""Conversion factors for the constants of tasks: degrees to radians, multiples of gravity, seconds to policy steps."""

DEG = 0.017453292519943295  # [rad]
G = 9.81  # [m/s^2] or [N/kg], on Earth
SECOND = 60.0  # policy steps

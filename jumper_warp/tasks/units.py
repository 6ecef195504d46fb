"""Units in which the constants of tasks are written."""

DEG = 0.017453292519943295  # [rad]
G = 9.81  # [m/s^2] or [N/kg], on Earth
SECOND = 60.0  # policy steps

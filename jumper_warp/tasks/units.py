"""Units that the tables of tasks are written in."""

DEG = 0.017453292519943295
"""[rad]"""
G = 9.81
"""[m/s^2] Gravity; an acceleration, or the force on a kilogram."""
SECOND = 60.0
"""Policy steps."""

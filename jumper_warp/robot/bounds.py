"""Ranges of values that are plausible for a robot, to detect wrong units; it may be large enough to carry a person."""

from __future__ import annotations

from typing import NamedTuple


class Range(NamedTuple):
    """Closed interval [low, high] of values that are plausible for a quantity."""

    low: float  # in the unit
    high: float  # in the unit
    unit: str  # for messages; "" if dimensionless


LINK_MASS = Range(1.0e-3, 100.0, "kg")  # From a bracket to the trunk of a robot that carries a person
PLACE = Range(-2.0, 2.0, "m")  # Coordinate of a point in its link's frame; no leg is longer
MOTOR_SPEED = Range(0.1, 1.0e3, "rad/s")  # At the output of the gear; 1000 rad/s are 9500 rpm
ARMATURE = Range(1.0e-6, 1.0, "kg m^2")  # At the gear's output; 1 kg m^2 is ten times the inertia of a stretched leg
MOTOR_FRICTION = Range(0.0, 10.0, "N m")
KNEE_DAMPING = Range(1.0e-6, 10.0, "N m s/rad")
SPRING_STIFFNESS = Range(0.0, 1.0e4, "N/m")
"""Upper end: ten times the authors' springs; they swing at a third of the highest stable frequency at 1/480 s."""
SPRING_LENGTH = Range(0.0, 1.0, "m")

"""Springs between the two knees of a leg: they store energy in the squat and give it back in the push-off.

A spring pulls the knees together with k (l - r) where it is longer than its rest length r, and pushes them apart where
it is shorter. The knees are carried by the thighs alone, so that it turns outer and inner thigh and nothing else. It is
taken explicitly, at the angles at the start of a step: 1000 N/m swing at some 9 Hz on these legs, a tenth of what the
semi-implicit step can follow, and keep their energy on the average.
"""

import warp as wp

from ..kinematics.five_bar import FiveBar
from ..scalar import real, vec3


@wp.struct
class LegSpring:
    """The spring of one leg."""

    stiffness: real  # [N/m], 0: none, and no gradient by it
    length: real  # [m] at rest


@wp.func
def spring_torque(spring: LegSpring, loop: FiveBar) -> vec3:
    """Return the torques [N m] of a leg's spring on its motors: lateral, outer, inner."""
    span = loop.outer_knee - loop.inner_knee
    length = wp.max(wp.length(span), real(1.0e-4))
    pull = spring.stiffness * (spring.length / length - real(1.0)) * span  # [N] on the outer knee
    return vec3(real(0.0), wp.dot(pull, loop.outer_knee_do), -wp.dot(pull, loop.inner_knee_di))

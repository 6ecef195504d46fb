"""Springs between the two knees of a leg, which store energy in the squat and return it in the push-off.

A spring of length l pulls the knees together with the force k (l - r), r its rest length; it pushes where l < r. The
knees move with the thighs alone, so only the outer and the inner motor feel it. The force is explicit: it uses the
angles at the start of a step. 1000 N/m oscillates at about 9 Hz on these legs, a tenth of the frequency at which the
semi-implicit step becomes unstable.
"""

import warp as wp

from ..kinematics.five_bar import FiveBar
from ..scalar import real, vec3


@wp.struct
class LegSpring:
    """Stiffness and rest length of the spring between the knees of one leg."""

    stiffness: real  # [N/m]; 0: no spring, and no gradient with respect to the stiffness
    length: real  # [m] at rest


@wp.func
def spring_torque(spring: LegSpring, loop: FiveBar) -> vec3:
    """Return the torques [N m] of a leg's spring on its motors: lateral (0), outer, inner.

    The torques are the force of the spring times the velocities of the knees per motor rate. A positive torque opens
    the thighs, so a stretched spring gives negative torques.
    """
    span = loop.outer_knee - loop.inner_knee
    length = wp.max(wp.length(span), real(1.0e-4))
    pull = spring.stiffness * (spring.length / length - real(1.0)) * span  # [N] on the outer knee
    return vec3(real(0.0), wp.dot(pull, loop.outer_knee_do), -wp.dot(pull, loop.inner_knee_di))

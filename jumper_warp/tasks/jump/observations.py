"""Observation terms of the jump tasks' policies and critics."""

from jumper_warp.kernels.jump import observations as jump
from jumper_warp.kernels.mdp import observations as obs
from jumper_warp.tasks.observations import DRAWN, POSITION_NOISE, ROBOT, exact
from jumper_warp.tasks.terms import ObservationTerm

HEIGHT = ObservationTerm(obs.height, noise=POSITION_NOISE)

VERTICAL = (ObservationTerm(jump.wanted_height), ObservationTerm(jump.jump_command), HEIGHT, *ROBOT)
"""Policy observation of the vertical jump."""

HORIZONTAL = (ObservationTerm(jump.goal, noise=POSITION_NOISE), HEIGHT, *ROBOT)
"""Policy observation of jumps to a goal position."""

SIGHT = ObservationTerm(jump.block_ahead)  # exact, for critics

SIGHTED = (*HORIZONTAL, SIGHT.replace(noise=0.01))
"""Policy observation of `horizontal_jump_sighted`: also the block's edges and height, with noise of 0.01 m."""

EPISODE = (
    ObservationTerm(jump.phase),
    ObservationTerm(jump.phase_times),
    ObservationTerm(jump.height_errors),
    ObservationTerm(jump.landing_miss),
    ObservationTerm(jump.way),
    ObservationTerm(obs.paw_forces),
)
"""Observation terms of the jump's progress, which only a simulation can measure, for critics."""


def critic(policy: tuple[ObservationTerm, ...], *extra: ObservationTerm) -> tuple[ObservationTerm, ...]:
    """Return a critic's observation terms: the policy's without noise and delay, jump progress, parameters, `extra`."""
    return (*exact(policy), *EPISODE, *DRAWN, *extra)

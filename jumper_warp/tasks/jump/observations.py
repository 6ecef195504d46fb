"""What policies of the jump tasks see, and their critics."""

from jumper_warp.kernels.jump import observations as jump
from jumper_warp.kernels.mdp import observations as obs
from jumper_warp.tasks.observations import DRAWN, POSITION_NOISE, ROBOT, exact
from jumper_warp.tasks.terms import ObservationTerm

HEIGHT = ObservationTerm(obs.height, noise=POSITION_NOISE)

VERTICAL = (ObservationTerm(jump.wanted_height), ObservationTerm(jump.jump_command), HEIGHT, *ROBOT)
"""Of the vertical jump."""

HORIZONTAL = (ObservationTerm(jump.goal, noise=POSITION_NOISE), HEIGHT, *ROBOT)
"""Of jumps to places."""

SIGHT = ObservationTerm(jump.block_ahead)
"""Of the block ahead, exact, for critics."""

SIGHTED = (*HORIZONTAL, SIGHT.replace(noise=0.01))
"""Of jumps to places by robots that see the edges ahead to a centimetre."""

EPISODE = (
    ObservationTerm(jump.phase),
    ObservationTerm(jump.phase_times),
    ObservationTerm(jump.height_errors),
    ObservationTerm(jump.landing_miss),
    ObservationTerm(jump.way),
    ObservationTerm(obs.paw_forces),
)
"""What only a simulation knows of a jump."""


def critic(policy: tuple[ObservationTerm, ...], *more: ObservationTerm) -> tuple[ObservationTerm, ...]:
    """Return the critic's terms: the policy's without noise, the episode's, more of them, and the drawn parameters."""
    return (*exact(policy), *EPISODE, *DRAWN, *more)

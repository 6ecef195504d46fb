"""Numbers of the random streams of turning in flight: which are taken, and by what."""

# of an episode (stream `RESET`), and branches of it
DEFAULT_LEGS, SPIN, EPISODE_STEPS = 1, 13, 16  # SPIN: to 15
ORIENTATION_BRANCH, TURN_BRANCH = 200, 300

# of an attempt at a start state (branches 0 to 7 of an episode), the first of four: one a leg
LATERAL, OUTER, INNER = 20, 24, 28

# of an orientation
QUAT = 0  # to 2

# of a turn, and of its axis (a branch)
ANGLE, AXIS_BRANCH = 8, 100
ALONG_BODY, BODY_AXIS, SIGN, AXIS_Z, AXIS_AROUND = 3, 4, 5, 6, 7  # ALONG_BODY: whether about an axis of the body

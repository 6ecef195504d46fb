"""Indices in the random streams of velocity tracking (`mdp.random.uniform`), one name for each sampled quantity."""

# in the stream `RESET` of an episode
DEFAULT_POSE, HEADING, GAIT_PHASE = 1, 12, 16
ROW, COL = 90, 91  # of the map

# of a command: in `RESET`, or within an episode in the stream `COMMAND`
KIND, NARROW, TURN, AHEAD, SIDE, LASTS = 80, 81, 82, 83, 84, 85  # NARROW: whether within `first_range`

# in branches 0 to 7 of an episode, one per attempt at a start state; 20 to 27 are those of `mdp.starts`
OFFSET_X, OFFSET_Y, HEIGHT = 2, 3, 4
LIN_VEL, ANG_VEL = 5, 13  # each the first of three: one an axis
ROLL, PITCH = 10, 11
LIFTED, LIFT = 28, 32  # the first of four: one a leg

"""Numbers of the random streams of velocity tracking: which are taken, and by what."""

# of an episode (stream `RESET`)
DEFAULT_POSE, HEADING, GAIT_PHASE = 1, 12, 16
ROW, COL = 90, 91  # of the map

# of a command, at a reset or within an episode (stream `COMMAND`)
KIND, NARROW, TURN, AHEAD, SIDE, LASTS = 80, 81, 82, 83, 84, 85

# of an attempt at a start state (branches 0 to 7 of an episode); 20 to 27 are those of `mdp.starts`
OFFSET_X, OFFSET_Y, HEIGHT = 2, 3, 4
LIN_VEL, ANG_VEL = 5, 13  # three each
ROLL, PITCH = 10, 11
LIFTED, LIFT = 28, 32  # the first of four: one a leg

"""Indices in the random streams of the attitude task (`mdp.random.uniform`), one name for each sampled quantity."""

# in the stream `RESET` of an episode; `*_BRANCH`: numbers for `fold_in`
DEFAULT_LEGS, SPIN, EPISODE_STEPS = 1, 13, 16  # SPIN: three indices, 13 to 15
ORIENTATION_BRANCH, TURN_BRANCH = 200, 300

# in branches 0 to 7 of an episode, one per attempt at a start state; each name is the first of four indices, one a leg
LATERAL, OUTER, INNER = 20, 24, 28

# in ORIENTATION_BRANCH
QUAT = 0  # three indices, 0 to 2

# in TURN_BRANCH; the second line in its AXIS_BRANCH
ANGLE, AXIS_BRANCH = 8, 100
ALONG_BODY, BODY_AXIS, SIGN, AXIS_Z, AXIS_AROUND = 3, 4, 5, 6, 7  # ALONG_BODY: whether about an axis of the body

"""Indices in the random streams of a jump (`mdp.random.uniform`), one name for each sampled quantity.

Alternatives share indices: a start samples only the quantities of its mode, an episode only the quantities of its
ground.
"""

# in the stream `RESET` of an episode; GOAL and AGAIN also in `COMMAND`, for the next jump of an episode
START_MODE, HEADING = 1, 13
GOAL = 50  # three indices, 50 to 52
COMMAND_STEP, LANDED_STEPS = 9, 9  # policy steps until the command; since touchdown, of those just landed
AGAIN, AGAIN_STEP = 18, 19  # whether, and when, the next goal is commanded
GROUND, BLOCK_HEIGHT = 60, 63
PLATFORM_ROOM_X, PLATFORM_ROOM_Y = 61, 62
BLOCK_NEAR_SIDE, BLOCK_FAR_ROOM, BLOCK_SIDE_ROOM, BLOCK_MASS, BLOCK_FRICTION = 61, 62, 64, 65, 66

# in branches 0 to 7 of an episode, one per attempt at a start state; 20 to 27 are those of `mdp.starts`
OFFSET_X, OFFSET_Y = 2, 3
YAW, PITCH, ROLL = 10, 11, 12
HEIGHT, FORWARD_PITCH, LEAN = 4, 17, 53  # standing; the lean depends on HEIGHT, too
LANDED_HEIGHT, LANDED_SPEED, LANDED_AHEAD = 4, 5, 14
TAKEOFF_HEIGHT, TAKEOFF_AHEAD, TAKEOFF_ANGLE, TAKEOFF_PITCH = 4, 14, 16, 56
FLIGHT_TIME, FLIGHT_LATERAL, FLIGHT_TRANSVERSAL = 5, 6, 7
LEG_OUTER, LEG_INNER, LEG_LATERAL = 30, 34, 38  # the first of four: one a leg
TOUCHDOWN_TIME, TOUCHDOWN_BEHIND, PAW_DEPTH = 5, 15, 8
PUSH_LENGTH, PUSH_ACCELERATION = 54, 55

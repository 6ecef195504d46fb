"""Colors that pictures, films, recordings and plots share: Okabe and Ito's palette, safe for color-blind readers."""

LEG_COLORS = {
    "FL": (0.0, 0.447, 0.698),
    "FR": (0.835, 0.369, 0.0),
    "BL": (0.0, 0.620, 0.451),
    "BR": (0.800, 0.475, 0.655),
}  # RGB, each in [0, 1]
COMMAND_COLOR = (0.902, 0.624, 0.0)  # RGB of what is commanded
ACTUAL_COLOR = (0.0, 0.447, 0.698)  # RGB of what the robot does
GOAL_COLOR = (0.835, 0.369, 0.0)  # RGB of goals
BASE_COLOR = (0.15, 0.15, 0.18)  # RGB of the base's path

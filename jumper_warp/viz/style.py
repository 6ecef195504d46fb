"""Colors of legs, commands and measurements in plots and scenes: RGB, each in [0, 1].

They are from the palette of Okabe and Ito, which color-blind readers can distinguish.
"""

LEG_COLORS = {
    "FL": (0.000, 0.447, 0.698),  # blue
    "FR": (0.902, 0.624, 0.000),  # orange
    "BL": (0.000, 0.620, 0.451),  # green
    "BR": (0.800, 0.475, 0.655),  # purple
}  # By leg, in the order in which legs are shown
COMMAND_COLOR = (0.835, 0.369, 0.000)  # vermilion
ACTUAL_COLOR = (0.000, 0.447, 0.698)  # blue
GOAL_COLOR = COMMAND_COLOR  # a goal is a commanded place
BASE_COLOR = (0.15, 0.15, 0.18)  # nearly black: the path of the base, and scales in pictures
SERIES_COLORS = (
    *LEG_COLORS.values(), (0.337, 0.706, 0.914), COMMAND_COLOR, (0.941, 0.894, 0.259), (0.5, 0.5, 0.5), BASE_COLOR,
)  # fmt: skip
"""Colors of many series, in order."""


def css(color: tuple[float, float, float]) -> str:
    """Return a color as CSS."""
    return f"rgb({','.join(str(round(255 * part)) for part in color)})"

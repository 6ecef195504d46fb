"""Mirror images: observations of a robot that is mirrored about its x-z plane (left-right) or y-z plane (front-back).

A mirror image is a signed permutation of columns. Entry i names the column, counted from 1, that becomes column i; it
is negative if the sign changes. Lateral angles are positive outward, and transversal angles away from the leg's other
link, so motors swap sides and keep their signs. A training can use mirror images, since the robot is symmetric.
"""

from typing import Any

VECTOR = (1, -2, 3)  # x, y, z of a vector, body axes
ROTATION = (-1, 2, -3)  # x, y, z of a rotation vector or an angular velocity, body axes
LEGS = (2, 1, 4, 3)  # FL, FR, BL, BR
MOTORS = (4, 5, 6, 1, 2, 3, 10, 11, 12, 7, 8, 9)  # lateral, outer, inner motor of each leg


FRONT_BACK_MOTORS = (*range(7, 13), *range(1, 7))


def set_mirror(columns: tuple[int, ...], *functions: Any, front_back: tuple[int, ...] | None = None) -> None:
    """Set the mirror image of the values of observation terms, the attribute `mirror` of their functions.

    front_back: the image by the y-z plane, their attribute `front_back`; None: not known.
    """
    for function in functions:
        function.mirror, function.front_back = columns, front_back

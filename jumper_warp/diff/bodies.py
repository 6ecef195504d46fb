"""Gradients w.r.t. bodies' masses, centres of mass and inertias, from those w.r.t. the kernels' parameter table."""

from __future__ import annotations

import numpy as np

from jumper_warp.kernels.layout import BASE, BODIES, LEG_BODIES, LEG_ROWS, MOMENT_ROWS

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Entries of packed second moments and inertias: xx, yy, zz, xy, xz, yz."""


def moment_rows(body: int) -> slice:
    """Return the rows of the kernels' parameter table with a body's mass and first and second moments of mass.

    A slice of ten rows: mass, 3 first and 6 second moments, see `PAIRS`. body: 0 is the base; then 5 links of each leg
    FL, FR, BL, BR, as in the model.
    """
    leg, link = divmod(body - 1, int(LEG_BODIES))
    first = int(BASE) if body == 0 else leg * int(LEG_ROWS) + link * MOMENT_ROWS
    return slice(first, first + MOMENT_ROWS)


def body_gradients(table: np.ndarray, gradient: np.ndarray) -> dict[str, np.ndarray]:
    """Convert a gradient w.r.t. the kernels' parameter table to gradients w.r.t. bodies' mass, com and inertia.

    They are w.r.t. mass [kg], com [m] and inertia about the com [kg m^2], in link axes. table, gradient: parameter
    table and gradient w.r.t. it, (321, num_worlds). The table holds first moments m c and second moments S = 1/2 tr(I)
    1 - I + m c c^T (parallel axes). Returned: mass (21, num_worlds), com (21, 3, num_worlds), inertia (21, 6,
    num_worlds) as `PAIRS`; an off-diagonal entry stands for both symmetric entries.
    """
    worlds = table.shape[1]
    mass = np.zeros((int(BODIES), worlds))
    com, inertia = np.zeros((int(BODIES), 3, worlds)), np.zeros((int(BODIES), 6, worlds))
    for body in range(int(BODIES)):
        rows = moment_rows(body)
        moments, by_moments = table[rows].astype(float), gradient[rows].astype(float)
        c = moments[1:4] / moments[0]
        by_second = by_moments[4:10]
        mass[body] = by_moments[0] + np.sum(c * by_moments[1:4], axis=0)
        com[body] = moments[0] * by_moments[1:4]
        for (i, j), s in zip(PAIRS, by_second, strict=True):
            mass[body] += s * c[i] * c[j]
            com[body, i] += moments[0] * s * c[j]
            com[body, j] += moments[0] * s * c[i]
        inertia[body, :3] = 0.5 * by_second[:3].sum(axis=0) - by_second[:3]
        inertia[body, 3:] = -by_second[3:]
    return {"mass": mass, "com": com, "inertia": inertia}

"""Terminations that every task can use, by hand."""

import math

import numpy as np
import pytest

from jump_helpers import DEG, Table, tilted_by
from jumper_warp.kernels.mdp import terminations

HIGH, ONE = {"pos": (0.0, 0.0, 1.0)}, np.eye(12)[7]
NAN = np.where(ONE > 0.0, math.nan, 0.0)
AXES = [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.6, 0.8, 0.0)]
TERMS = {  # numbers, rows (whether it holds, robot, episode)
    "too_long": ({"steps": 1200.0}, [(steps == 1200, {}, {"steps": steps}) for steps in (1199, 1200)]),
    "diverged": ({}, [(True, robot, {}) for robot in (
        {"lin_vel": (0.0, 0.0, 15.1)}, {"ang_vel": (0.0, -40.1, 0.0)}, {"rate": -120.1 * ONE},
        {"pos": (math.nan, 0.0, 0.4)}, {"lin_vel": (0.0, math.inf, 0.0)}, {"ang_vel": (0.0, math.nan, 0.0)},
        {"rate": NAN}, {"angle": NAN})] + [(False, robot, {}) for robot in (
        {}, {"lin_vel": (0.0, 0.0, 14.9)}, {"ang_vel": (0.0, 39.9, 0.0)}, {"rate": -119.9 * ONE})]),
    "low_base": ({"height": 0.2}, [(z < 0.2, robot, {})  # above the ground below
                                   for z in (0.21, 0.19) for robot in ({"pos": (0.0, 0.0, z)}, HIGH | {"height": z})]),
    "tilted": ({"angle": 25.0 * DEG}, [(angle > 25.0, tilted_by(angle * DEG, axis), {})
                                       for axis in AXES for angle in (24.9, 25.1, 180.0)]
               + [(False, tilted_by(2.0, (0.0, 0.0, 1.0)), {})]),
    "fallen": ({"angle": 25.0 * DEG}, [
        (angle > 25.0 and contacts > 0, tilted_by(angle * DEG) | {"contacts": contacts}, {})
        for angle in (24.9, 25.1) for contacts in (0, 1)]),
    "collided": ({}, [(flags > 0, {"collisions": flags}, {}) for flags in (0, *(1 << bit for bit in range(8)))]),
}  # fmt: skip
holds = Table([getattr(terminations, name) for name in TERMS], bool)


@pytest.mark.parametrize("name", TERMS)
def test_termination_by_hand(name):
    holds.check(name, *TERMS[name])

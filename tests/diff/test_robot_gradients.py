"""Gradients of a jump of the project's robots beside the Jumper against central differences, in double precision."""

import dataclasses

import numpy as np
import pytest

from jumper_warp.diff.rollout import GEOMETRY_NAMES, Rollout, compact
from jumper_warp.kernels.layout import BASE, LEG_ROWS, OUTER_SHANK
from jumper_warp.robot.measures import filter_for, motors_for
from jumper_warp.robot.model import build_model, standing_configuration
from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter
from jumper_warp.robot.overlay import load_overlay
from rollout_helpers import OUTPUTS, gradients, run, weighted_sum, weights

TICKS = 20


@pytest.mark.parametrize("name", ["long_jumper", "small_direct_drive", "heavy"])
def test_gradients_of_a_jump_match_differences(name):
    robot = load_overlay(name).description
    squat = dataclasses.replace(robot, poses={"squat": (0.0, 1.5)})
    of = Rollout(
        build_model(1, description=robot, visuals=False, device="cpu"), motors_for(jumping_motors(), robot),
        filter_for(vertical_jump_filter(), robot), description=robot, double=True, threads=1,
    )  # fmt: skip
    q, qd = (row[:, 0] for row in compact(standing_configuration(squat, "squat"), np.zeros(38)))
    q[2] -= 1.0e-4
    targets = np.tile([0.0, 0.6, 0.5], (TICKS, 4))
    targets[:3] = q[7:]
    values = {"targets": targets, "q": q, "qd": qd, "initial_target": q[7:], "wrench": np.zeros((TICKS, 6))}
    values |= {key: array.numpy()[..., 0].astype(float) for key, array in of.parameters.items()}
    # four paws without lateral axes push against each other: their sideways impulses are not unique
    kinds = ("q", "qd", "torque") if name == "small_direct_drive" else OUTPUTS
    by, found = gradients(of, values, weights(run(of, values), kinds))
    for key, entries, step in (
        ("targets", [(4, 1), (5, 8)], 2.0e-6), ("table", [int(BASE), int(LEG_ROWS + OUTER_SHANK)], 1.0e-6),
        ("kp", [1, 8], 1.0e-5), ("q", [2, 4], 1.0e-7),
    ):  # fmt: skip
        expected = []
        for entry in entries:
            sums = []
            for side in (-1.0, 1.0):
                moved = values | {key: values[key].copy()}
                moved[key][entry] += side * step
                sums.append(weighted_sum(run(of, moved), by)[0])
            expected.append((sums[1] - sums[0]) / (2.0 * step))
        scale = np.abs(expected).max()
        assert scale > 1.0e-6
        np.testing.assert_allclose([found[key][entry] for entry in entries], expected, rtol=0.0, atol=2.0e-5 * scale)
    lengths, column = of.geometry(), GEOMETRY_NAMES.index("shank")
    sums = []
    for side in (-1.0, 1.0):
        moved = lengths.copy()
        moved[2, column] += side * 1.0e-7
        of.set_geometry(moved)
        sums.append(weighted_sum(run(of, values), by)[0])
    of.set_geometry(lengths)
    assert found["geometry"][2, column] == pytest.approx((sums[1] - sums[0]) / 2.0e-7, rel=2.0e-5)

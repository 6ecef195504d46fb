"""Joint optimisation of leg and jump: gradients in double precision, the robots of designs, and a tiny run."""

import numpy as np
import pytest
import torch

from experiments import codesign
from jumper_warp.diff.rollout import Rollout
from jumper_warp.robot.description import leg_dimensions
from jumper_warp.robot.gravity import EARTH
from jumper_warp.robot.model import build_model
from jumper_warp.robot.overlay import load_overlay
from jumper_warp.utils.output import read_values
from support import leg_jumps

DESIGN = [0.9, 1.15, 0.3]
STEPS = {"design": 1.0e-7, "targets": 1.0e-6}  # of the central differences, [1] and [rad]
ENTRIES = {"design": [(0,), (1,), (2,)], "targets": [(5, 0), (18, 3), (30, 1)]}


def push_off() -> torch.Tensor:
    """Return targets [rad], (PUSH, 4), of a squat and a push-off ahead; no two are equal."""
    targets = 1.5 + 0.01 * torch.arange(4 * leg_jumps.PUSH, dtype=torch.float64).reshape(-1, 4).sin()
    targets[27:] -= 1.5
    return targets + 0.2 * torch.tensor([-1.0, 1.0, 1.0, -1.0])


def test_gradients_by_lengths_stiffness_and_targets_match_differences():
    values = {"targets": push_off(), "design": torch.tensor(DESIGN, dtype=torch.float64)}
    moves = [(name, entry, side) for name in ENTRIES for entry in ENTRIES[name] for side in (-1.0, 1.0)]
    batch = {name: value[..., None].repeat(*(1,) * value.dim(), 1 + len(moves)) for name, value in values.items()}
    for world, (name, entry, side) in enumerate(moves):
        batch[name][(*entry, 1 + world)] += side * STEPS[name]
    for tensor in batch.values():
        tensor.requires_grad_()
    jumps = leg_jumps.Jumps(1 + len(moves), EARTH, 0.6, double=True, device="cpu", threads=1)
    jump = jumps(batch["targets"], batch["design"])
    assert 0.2 < jump.distance[0] and jump.flight[0] < 8 * jumps.steps, "the jump does not end in the simulated time"
    for result in (jump.distance, jump.energy, jump.faults):
        found = torch.autograd.grad(result[0], list(batch.values()), retain_graph=True)
        for by, name in zip(found, batch, strict=True):
            pairs = result.detach()[[1 + i for i, move in enumerate(moves) if move[0] == name]].reshape(-1, 2)
            expected = (pairs[:, 1] - pairs[:, 0]).numpy() / (2.0 * STEPS[name])
            scale = np.abs(expected).max()
            assert scale > 1.0e-3
            ours = [by[(*entry, 0)].item() for entry in ENTRIES[name]]
            np.testing.assert_allclose(ours, expected, rtol=0.0, atol=2.0e-6 * scale)


def test_parameters_are_those_of_the_robots_of_the_designs():
    designs = np.array([DESIGN, [1.3, 0.8, 1.0]])
    robots = [leg_jumps.robot_of(design) for design in designs]
    model = build_model(2, description=robots, visuals=False, device="cpu")
    expected = Rollout(model, description=robots, double=True, threads=1)
    jumps = leg_jumps.Jumps(2, EARTH, 0.6, double=True, device="cpu", threads=1)
    found = jumps.parameters(torch.tensor(designs.T))
    table = expected.parameters["table"].numpy()
    np.testing.assert_allclose(found["table"].numpy(), table, rtol=2.0e-5, atol=1.0e-9)
    np.testing.assert_allclose(found["geometry"].numpy(), expected.geometry(), rtol=0.0, atol=1.0e-12)
    q = torch.tensor(expected.standing()[0])
    np.testing.assert_allclose(jumps.clearance(q, torch.tensor(designs.T))[0], 0.0, atol=1.0e-7)


def test_simulations_confirm_the_optimised_jump(tmp_path):
    args = codesign.Args(count=4, iterations=6, out=tmp_path, device="cpu", threads=1)
    values = codesign.main(args)
    assert read_values(tmp_path) == values
    for name in ("nominal", "farthest", "least"):
        robot = load_overlay(tmp_path / f"{name}.json").description
        leg = leg_dimensions(robot, "BR")
        assert (leg.thigh, leg.shank) == pytest.approx((values[f"{name}_thigh_m"], values[f"{name}_shank_m"]))
        distance = values[f"{name}_distance_m"]
        assert distance > 0.4
        assert values[f"{name}_jumper_distance_m"] == pytest.approx(distance, abs=0.001)
        assert values[f"{name}_jumper_energy_j"] == pytest.approx(values[f"{name}_energy_j"], rel=0.001)
        assert values[f"{name}_mujoco_distance_m"] == pytest.approx(distance, abs=0.05)
    assert values["nominal_thigh_m"] == pytest.approx(0.175)
    assert (tmp_path / "codesign.png").stat().st_size > 10_000

"""Rollouts: forward pass against the simulation, threads, the PyTorch bridge, and refusals of bad input."""

import math

import numpy as np
import pytest
import torch
import warp as wp

from columns import Z
from jumper_warp.diff.rollout import Rollout, compact
from jumper_warp.diff.torch_rollout import simulate
from jumper_warp.robot.model import build_model
from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter
from jumper_warp.sim.simulation import Simulation
from jumper_warp.utils.errors import InputError
from tests.helpers.rollout_helpers import DT, SUBSTEPS, defaults, push_off, rollout, run, squat


def test_rollout_matches_simulation_bitwise():
    """States and torques are equal bitwise, forces (impulses over the step of 1/480 s) to rounding."""
    settings = {"command_filter": vertical_jump_filter(), "tolerance": 1.0e-5}
    simulation = Simulation(2, motors=jumping_motors(), visuals=False, **settings)
    model = build_model(2, visuals=False)
    of = Rollout(model, jumping_motors(), **settings)
    targets = np.random.default_rng(0).uniform(0.2, 1.0, (12, 12, 2)).astype(np.float32)  # [rad] (steps, 12, worlds)
    trajectory = of.run(targets, *of.standing())
    for target in targets:
        simulation.target.assign(target)
        simulation.step()
    q, qd = compact(simulation.joint_q(), simulation.joint_qd(), 2)
    np.testing.assert_array_equal(trajectory.q.numpy()[-1], q)
    np.testing.assert_array_equal(trajectory.qd.numpy()[-1], qd)
    np.testing.assert_array_equal(trajectory.torque.numpy()[-1], simulation.torque.numpy())
    np.testing.assert_allclose(trajectory.impulse.numpy()[-1] * 480, simulation.paw_force.numpy(), rtol=1.0e-6)


def test_threads_do_not_change_trajectories_and_gradients():
    model = build_model(40, visuals=False)
    results = []
    for threads in (1, 2):
        of = Rollout(model, command_filter=vertical_jump_filter(), double=True, dt=DT, substeps=4, threads=threads)
        assert len(of.slices) == threads
        q, qd = (np.repeat(row[:, None], 40, axis=1) for row in squat())
        q[2] += np.linspace(0.0, 0.1, 40)
        trajectory = of.run(push_off(6), q, qd)
        gradients = of.backward(trajectory, qd=wp.full_like(trajectory.qd, 1.0))
        results.append({"q": trajectory.q.numpy()} | {f"by {name}": array.numpy() for name, array in gradients.items()})
    for name, values in results[0].items():
        np.testing.assert_array_equal(results[1][name], values, err_msg=name)


def test_rollout_continues_from_end():
    whole = run(rollout(), defaults())
    first = rollout().run(push_off()[:5], *squat())
    rest = rollout().run(push_off()[5:], **first.end())
    np.testing.assert_array_equal(rest.q.numpy()[-1], whole.q.numpy()[-1])


def test_a_wrench_acts_in_double_precision():
    """On a robot in the air with idle motors, doubling a force of 0.1 µN doubles the speed that it adds."""
    q, qd = squat()
    q[2] = 1.0  # [m]
    of = rollout()
    run(of, defaults() | {"kp": np.zeros(12), "kd": np.zeros(12)})  # write the parameters
    speeds = []
    for force in (0.0, 1.0e-7, 2.0e-7):
        wrench = np.tile([force, 0.0, 0.0, 0.0, 0.0, 0.0], (2, 1))
        speeds.append(of.run(np.zeros((2, 12)), q, 0.0 * qd, wrench=wrench).qd.numpy()[-1, 0, 0])
    added = np.diff(speeds)
    assert added[1] == pytest.approx(added[0], rel=1.0e-5)
    # more than the speed [m/s] of a rigid robot of 14.5 kg, as the legs lag behind; less than of 4 kg
    assert 1.0e-7 * 2 * SUBSTEPS * DT / 14.6 < added[0] < 1.0e-7 * 2 * SUBSTEPS * DT / 4.0


def tensors():
    """Return q (19,) and qd (18,) of `squat` as tensors."""
    q, qd = squat()
    return torch.tensor(q), torch.tensor(qd)


def losses(trajectory):
    """Return a weighted sum of squared torques and vertical impulses over steps, motors, paws and worlds."""
    return 1.0e-3 * trajectory.torque.square().sum() + 0.01 * trajectory.impulse[..., Z].sum()


def test_torch_gradients_match_central_differences():
    of, (q, qd) = rollout(2), tensors()
    targets = torch.tensor(push_off(10)).requires_grad_()
    kp = torch.full((12,), 70.0, dtype=torch.float64, requires_grad=True)
    lengths = torch.tensor(of.geometry()).requires_grad_()

    def loss(targets, kp, lengths):  # `losses` plus the base's final height
        trajectory = simulate(of, targets, q, qd, kp=kp, geometry=lengths)
        return losses(trajectory) + trajectory.q[-1, 2].sum()

    loss(targets, kp, lengths).backward()
    # FL_outer of step 4 [rad], kp of FL_outer [N m/rad], thigh of FL [m], each with its step
    for tensor, entry, h in ((targets, (4, 1), 1.0e-6), (kp, (1,), 1.0e-4), (lengths, (0, 7), 1.0e-7)):
        ends = []
        for side in (h, -h):
            moved = [t.detach().clone() for t in (targets, kp, lengths)]
            next(m for m, t in zip(moved, (targets, kp, lengths), strict=True) if t is tensor)[entry] += side
            ends.append(loss(*moved).item())
        simulate(of, targets.detach(), q, qd, geometry=lengths.detach())
        assert tensor.grad[entry].item() == pytest.approx((ends[0] - ends[1]) / (2.0 * h), rel=1.0e-5)


def test_each_world_has_lengths_of_its_own():
    of, (q, qd) = rollout(2), tensors()
    targets, same = torch.tensor(push_off(10)), torch.tensor(of.geometry())
    lengths = torch.stack([same, same + 0.01], dim=-1)
    both = lengths.clone().requires_grad_()
    joint = simulate(of, targets, q, qd, geometry=both)
    np.testing.assert_array_equal(of.geometry(), lengths)
    losses(joint).backward()
    for world in range(2):
        alone = lengths[..., world].clone().requires_grad_()
        single = simulate(of, targets, q, qd, geometry=alone)
        torch.testing.assert_close(joint.q[..., world], single.q[..., world], rtol=0.0, atol=0.0)
        loss = 1.0e-3 * single.torque[..., world].square().sum() + 0.01 * single.impulse[:, :, world, Z].sum()
        loss.backward()
        torch.testing.assert_close(both.grad[..., world], alone.grad, rtol=0.0, atol=0.0)
    simulate(of, targets, q, qd, geometry=same)


@pytest.mark.parametrize("seconds", [0.0, 0.011, 0.04])
def test_torch_gradients_step_by_step_match_the_whole(seconds):
    """Each policy step has its own call, as with a policy in the loop; a later run with other parameters has no effect.

    With a latency (seconds) a target acts in later calls, through `initial_target`.
    """
    of, (q, qd) = rollout(), tensors()
    results, latency = [], torch.full((1,), seconds, dtype=torch.float64)
    for stepwise in (False, True):
        targets = torch.tensor(push_off(8)).requires_grad_()
        kp = torch.full((12,), 70.0, dtype=torch.float64, requires_grad=True)
        if stepwise:
            state, total = {"q": q, "qd": qd}, 0.0
            for step in range(8):
                made = simulate(of, targets[step : step + 1], **state, kp=kp, latency=latency)
                state, total = made.end(), total + losses(made)
            total = total + state["q"][2].sum()
            simulate(of, targets.detach(), q, qd, kp=torch.full((12,), 20.0))
        else:
            made = simulate(of, targets, q, qd, kp=kp, latency=latency)
            total = losses(made) + made.q[-1, 2].sum()
        total.backward()
        results.append((total.item(), targets.grad.numpy(), kp.grad.numpy()))
    simulate(of, targets.detach(), q, qd, latency=0.0 * latency)
    for whole, stepped in zip(*results, strict=True):
        np.testing.assert_allclose(stepped, whole, rtol=0.0, atol=1.0e-12 * np.abs(whole).max())


def test_gradient_by_q_includes_default_initial_target():
    """With a latency motors first follow the initial angles by default: the gradient by q includes both effects."""
    of, (q, qd) = rollout.__wrapped__(), tensors()  # not cached: its parameters change
    targets, latency, results = torch.tensor(push_off(6)), torch.tensor([0.006], dtype=torch.float64), []  # [s]

    def height(q, **initial):  # [m] of the base at the end
        return simulate(of, targets, q, qd, latency=latency, **initial).q[-1, Z].sum()

    for explicit in (False, True):
        start = q.clone().requires_grad_()
        height(start, **({"initial_target": start[7:]} if explicit else {})).backward()
        results.append(start.grad)
    runs = [of.run(targets.numpy(), q.numpy(), qd.numpy(), initial_target=start) for start in (None, q[7:].numpy())]
    cotangent = np.zeros(runs[0].q.shape)
    cotangent[-1, Z] = 1.0
    by_default, by_q_alone = (of.backward(made, q=of.array(cotangent))["q"].numpy() for made in runs)
    results.append(by_default)
    for entry in (8, 9):  # FL_outer, FL_inner
        step = torch.zeros_like(q)
        step[entry] = 1.0e-8
        expected = (height(q + step) - height(q - step)).item() / 2.0e-8
        for gradient in results:
            assert gradient[entry].item() == pytest.approx(expected, rel=1.0e-4)
        assert by_q_alone[entry].item() != pytest.approx(expected, rel=1.0e-2)


def test_second_derivatives_and_forward_mode_are_refused():
    of, targets, (q, qd) = rollout(), torch.zeros(2, 12, dtype=torch.float64, requires_grad=True), tensors()

    def height(values):
        return simulate(of, values, q, qd).q[-1, Z].sum()

    for second in (
        lambda: torch.autograd.functional.hessian(height, targets),
        lambda: torch.autograd.grad(height(targets), targets, create_graph=True),
    ):
        with pytest.raises(InputError, match="simulate has no second derivatives: create_graph must be False"):
            second()
    with pytest.raises(InputError, match="simulate has no forward mode"):
        torch.func.jvp(height, (targets.detach(),), (targets.detach(),))


def test_reverse_pass_refuses_changed_outputs_and_parameters():
    of, (q, qd) = rollout.__wrapped__(), tensors()  # not cached: its parameters change
    targets = torch.tensor(push_off(2)).requires_grad_()
    made = simulate(of, targets, q, qd)
    made.torque.div_(18.0)
    with pytest.raises(RuntimeError, match="inplace"):
        losses(made).backward()
    made = simulate(of, targets, q, qd)
    for name, other in (("kp", torch.full((12,), 30.0)), ("geometry", torch.tensor(of.geometry()))):
        simulate(of, targets, q, qd, **{name: other})
        with pytest.raises(ValueError, match=f"{name} was changed after this rollout"):
            losses(made).backward(retain_graph=True)
        made = simulate(of, targets, q, qd)


@pytest.mark.parametrize("seconds", [-0.05, -0.001, float("-inf"), float("nan")])
def test_negative_latency_counts_as_zero(seconds, monkeypatch):
    """Checks of the latency are off, as on a GPU; equal worlds stay equal with any latency."""
    monkeypatch.setattr("jumper_warp.diff.rollout.check_within", lambda *_: None)
    of, targets, ends = Rollout(build_model(4, visuals=False)), np.full((3, 12), 0.4), []
    for latency in (0.0, seconds):
        of.parameters["latency"].fill_(latency)
        trajectory = of.run(targets, *of.standing())
        gradients = of.backward(trajectory, qd=wp.full_like(trajectory.qd, 1.0))
        ends.append((trajectory.q.numpy()[-1], gradients["targets"].numpy()))
    if math.isfinite(seconds):
        np.testing.assert_array_equal(ends[1][0], ends[0][0])
        np.testing.assert_array_equal(ends[1][1], ends[0][1])
    for values in ends[1]:
        np.testing.assert_array_equal(values, np.repeat(values[..., :1], 4, axis=-1))


@pytest.fixture
def blocks_of_threads():
    """Enable blocks of several threads on the CPU."""
    wp.config.enable_cpu_blocks = True
    yield
    wp.config.enable_cpu_blocks = False


@pytest.mark.usefixtures("blocks_of_threads")
@pytest.mark.parametrize("every", [4, 2])
def test_thread_per_leg_matches_thread_per_world(every):
    """11 worlds (no multiple of 8) have latency, fading motors and a wrench, some in the air; they agree to 1e-9."""
    count = 11
    of = rollout(count, every=every)
    values = defaults() | {"latency": np.array(0.0061), "fade": np.array([4.0, 60.0])}
    values["wrench"][5:15] = [3.0, -2.0, 4.0, 0.1, -0.2, 0.3]
    values["q"] = np.repeat(values["q"][:, None], count, axis=1)
    values["q"][2] += np.linspace(0.0, 0.05, count)
    results = []
    for of.by_legs in (True, False):
        trajectory = run(of, values)
        names, rng = ("q", "qd", "torque", "impulse"), np.random.default_rng(0)
        cotangents = {name: rng.normal(size=getattr(trajectory, name).numpy().shape) for name in names}
        gradients = of.backward(
            trajectory, **{name: (of.vectors if name == "impulse" else of.array)(s) for name, s in cotangents.items()}
        )
        made = {name: getattr(trajectory, name).numpy().copy() for name in names}
        results.append(made | {f"by {name}": array.numpy().copy() for name, array in gradients.items()})
    for name, values in results[1].items():
        scale = np.abs(values).max()
        np.testing.assert_allclose(results[0][name], values, rtol=0.0, atol=1.0e-9 * scale, err_msg=name)


def test_first_run_on_two_threads_matches_one():
    """The kernel's module is unloaded before each run: no thread may launch before it is loaded."""
    model, targets = build_model(64, visuals=False), np.full((4, 12), 0.8)
    heights = []
    for threads in (1, 2):
        of = Rollout(model, double=True, threads=threads)
        of.dynamics.modules.rollout.rollout_kernel.module.unload()
        heights.append(of.run(targets, *of.standing()).q.numpy()[-1, 2])
    assert np.array_equal(*heights)

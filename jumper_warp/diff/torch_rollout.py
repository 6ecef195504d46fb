"""PyTorch bridge: the robot's simulation over policy steps as a differentiable function of tensors."""

from __future__ import annotations

import contextlib
from collections.abc import Container, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp
from torch.autograd.forward_ad import unpack_dual

from jumper_warp.diff.rollout import LATENCY_RANGE, Rollout, Trajectory
from jumper_warp.utils.checks import check_flags, check_type, check_within
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.threads import WARP_LOCK

COMMANDS = ("targets", "q", "qd", "initial_target", "wrench", "impulse")  # arguments of `Rollout.run`
OUTPUTS = ("q", "qd", "torque", "impulse", "filtered_target")  # differentiable arrays of a `Trajectory`


class TorchTrajectory(NamedTuple):
    """Simulated states, torques and impulses over policy steps as PyTorch tensors with gradients.

    T policy steps of S physics steps; K is T by default, see `Trajectory`. Do not change in place.
    """

    q: torch.Tensor  # (K + 1, 19, num_worlds) as in `Trajectory`: base origin [m], quaternion xyzw, motor angles [rad]
    qd: torch.Tensor  # (K + 1, 18, num_worlds) velocity of the base's COM [m/s], angular velocity, motor rates [rad/s]
    torque: torch.Tensor  # (T S, 12, num_worlds) [N m] motor torques
    impulse: torch.Tensor  # (T S, 4, num_worlds, 3) [N s] on the paws, world frame; force: over the physics step
    filtered_target: torch.Tensor  # (T, 12, num_worlds) [rad] targets after the command filter
    last_targets: torch.Tensor  # (steps, 12, num_worlds) [rad] the last of them and, with a latency, of those before

    def end(self) -> dict[str, torch.Tensor]:
        """Return the final state as arguments with which `simulate` continues; `impulse` has no gradient."""
        state = {"q": self.q[-1], "qd": self.qd[-1], "initial_target": self.last_targets}
        return state | {"impulse": self.impulse[-1].detach()}


def simulate(
    rollout: Rollout,
    targets: torch.Tensor,
    q: torch.Tensor,
    qd: torch.Tensor,
    *,
    initial_target: torch.Tensor | None = None,
    wrench: torch.Tensor | None = None,
    impulse: torch.Tensor | None = None,
    trusted: bool = False,
    **parameters: torch.Tensor,
) -> TorchTrajectory:
    """Simulate all worlds over policy steps as a PyTorch function, and return their trajectory.

    It can be differentiated once, in reverse mode, w.r.t. all tensors except `impulse`: the reverse pass raises
    InputError if `create_graph` is set. Arguments and shapes are those of `Rollout.run`, with or without the axis of
    worlds. parameters: entries of `Rollout.parameters`, or the legs' lengths `geometry` [m], (4, 10) for all worlds or
    (4, 10, num_worlds); they are written to the rollout and stay there, and have gradients only from the calls that
    they are passed to.
    trusted: do not check the values; otherwise on a GPU only the latency is checked, which waits for the device.

    A policy in the loop runs one policy step per call, each from `end()` of the previous one. Raises InputError:
    unknown parameter, not a tensor, wrong shape, not finite, or a latency outside of `LATENCY_RANGE`. The reverse pass
    raises it for a parameter that a later call has changed and that was not passed to this call.
    """
    check_type("rollout", rollout, Rollout)
    check_flags(trusted=trusted)
    named = {"targets": targets, "q": q, "qd": qd, "initial_target": initial_target, "wrench": wrench} | parameters
    given: dict[str, Any] = {
        name: tensor for name, tensor in named.items() if tensor is not None or name in COMMANDS[:3]
    }
    for name, tensor in given.items() if impulse is None else [*given.items(), ("impulse", impulse)]:
        if not isinstance(tensor, torch.Tensor):
            raise InputError(f"{name} must be a torch tensor, got {type(tensor).__name__}")
        if unpack_dual(tensor).tangent is not None:
            raise InputError("simulate has no forward mode (jvp): use the reverse mode, such as backward")
        if tensor.is_complex():
            raise InputError(f"{name} must be of real numbers, got {tensor.dtype}")
    if targets.dim() == 0:
        raise InputError("targets must have shape (T, 12, num_worlds), got ()")
    unknown = next((name for name in parameters if name not in rollout.parameters and name != "geometry"), None)
    if unknown is not None:
        raise InputError(
            f"a rollout has no parameter {unknown!r:.60}; it has {', '.join(rollout.parameters)}, geometry"
        )
    shapes = {"targets": (len(targets), 12), "q": (19,), "qd": (18,), "wrench": (len(targets), 6)}
    initial = q[7:] if initial_target is None else initial_target
    shapes |= {"initial_target": (len(initial), 12) if initial.dim() == 3 else (12,), "geometry": (4, 10)}
    shapes |= {name: array.shape[:-1] for name, array in rollout.parameters.items()}
    real = torch.float64 if rollout.real is wp.float64 else torch.float32
    for name, tensor in given.items():
        shared = name == "geometry" and tensor.dim() == 2
        full = (4, 10) if shared else (*shapes[name], rollout.num_worlds)
        if not shared and tuple(tensor.shape) == tuple(shapes[name]):
            tensor = tensor.unsqueeze(-1).expand(full)
        if tuple(tensor.shape) != full:
            raise InputError(f"{name} must have shape {full}, got {tuple(tensor.shape)}")
        given[name] = tensor.to(dtype=real).contiguous()
    given["initial_target"] = given.get("initial_target", given["q"][7:]).reshape(-1, 12, rollout.num_worlds)
    if impulse is not None:
        if tuple(impulse.shape) != (4, rollout.num_worlds, 3):
            raise InputError(f"impulse must have shape {(4, rollout.num_worlds, 3)}, got {tuple(impulse.shape)}")
        impulse = impulse.detach().to(dtype=real).contiguous()
    if not trusted:
        _check_numbers(given if impulse is None else given | {"impulse": impulse})
    *outputs, filtered = _Simulate.apply(rollout, tuple(given), impulse, *given.values())
    kept = max(rollout.targets_kept, len(given["initial_target"]))
    return TorchTrajectory._make((*outputs, filtered, torch.cat([given["initial_target"], filtered])[-kept:]))


def _check_numbers(given: dict[str, torch.Tensor]) -> None:
    """Raise InputError if a tensor of latencies for a rollout has values out of range.

    On a CPU also for commands that are not finite or parameters with NaN.
    """
    if "latency" in given:
        check_within("latency [s]", given["latency"].detach().cpu().numpy(), LATENCY_RANGE)
    for name, tensor in given.items():
        fits = tensor.is_cuda or (tensor.isfinite() if name in COMMANDS else ~tensor.isnan()).all()
        if not fits:
            raise InputError(f"{name} must be finite")


class _Simulate(torch.autograd.Function):
    """Autograd function with `Rollout.run` as its forward and `Rollout.backward` as its backward pass."""

    @staticmethod
    def forward(ctx: Any, rollout: Rollout, names: tuple[str, ...], impulse: Any, *tensors: torch.Tensor) -> tuple:
        """Simulate the forward pass of a rollout, and return its trajectory as tensors.

        First the parameters are written. names: of `tensors`, in order. Returned: `OUTPUTS`.
        """
        with WARP_LOCK, _stream(rollout):
            given = dict(zip(names, tensors, strict=True))
            _write_parameters(rollout, given)
            commands = {name: wp.from_torch(given[name].detach()) for name in COMMANDS if name in given}
            if impulse is not None:
                commands["impulse"] = wp.from_torch(impulse, dtype=rollout.dynamics.modules.scalar.vec3)
            trajectory = rollout.run(**commands)
        ctx.rollout = rollout
        ctx.names = names
        ctx.trajectory = trajectory
        ctx.writes = dict(rollout.writes)
        outputs = [wp.to_torch(getattr(trajectory, name)) for name in OUTPUTS]
        ctx.save_for_backward(*tensors, *outputs)  # outputs so that torch detects in-place changes
        ctx.set_materialize_grads(False)
        return tuple(outputs)

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor | None) -> tuple:
        """Return the gradients w.r.t. the inputs of a rollout, by its reverse pass.

        It uses the parameters of the forward pass; grads: w.r.t. `OUTPUTS`, None for zero.
        """
        if torch.is_grad_enabled():  # as `create_graph` sets it; gradients of a linear loss would have no graph
            raise InputError("simulate has no second derivatives: create_graph must be False")
        rollout = ctx.rollout
        trajectory = ctx.trajectory
        given = dict(zip(ctx.names, ctx.saved_tensors, strict=False))
        changed = {name for name, count in rollout.writes.items() if ctx.writes[name] != count}
        if lost := changed - given.keys():
            raise InputError(f"{min(lost)} was changed after this rollout: pass it to each call of simulate")
        with WARP_LOCK, _stream(rollout):
            _write_parameters(rollout, given, changed)
            cotangents = {name: _cotangent(trajectory, name, grad) for name, grad in zip(OUTPUTS, grads, strict=False)}
            gradients = rollout.backward(trajectory, **cotangents)
            by_inputs = []
            for name in ctx.names:
                grad = wp.to_torch(gradients[name].contiguous())
                by_inputs.append(grad.sum(-1) if given[name].dim() < grad.dim() else grad)
        return (None, None, None, *by_inputs)


def _cotangent(trajectory: Trajectory, name: str, grad: torch.Tensor | None) -> wp.array | None:
    """Convert the gradient w.r.t. one array of a trajectory from a PyTorch tensor to a Warp array.

    name: of the array, whose type it gets; None (zero) stays None.
    """
    if grad is None:
        return None
    return wp.from_torch(grad.detach().contiguous(), dtype=getattr(trajectory, name).dtype)


def _write_parameters(rollout: Rollout, given: dict[str, torch.Tensor], new: Container[str] | None = None) -> None:
    """Write the given robot parameters to the arrays of a rollout.

    `Rollout.writes` counts them, from which a reverse pass sees that a parameter is no longer that of its forward pass.
    new: names to count, by default all.
    """
    for name, tensor in given.items():
        if name in rollout.writes and (new is None or name in new):
            rollout.writes[name] += 1
        if name in rollout.parameters:
            wp.copy(rollout.parameters[name], wp.from_torch(tensor.detach()))
        elif name == "geometry":
            rollout.set_geometry(tensor.detach().cpu().numpy().astype(np.float64))


@contextlib.contextmanager
def _stream(rollout: Rollout) -> Iterator[None]:
    """Make Warp use PyTorch's stream within the context.

    Warp drops a stream, even its own, when a `wp.Stream` that wraps it is deleted, and then cannot capture a graph on
    it. So nothing is wrapped if PyTorch already uses Warp's stream, as it does with an environment.
    """
    device = rollout.device
    if not device.is_cuda or torch.cuda.current_stream().cuda_stream == wp.get_stream(device).cuda_stream:
        yield
        return
    with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream()), sync_enter=False):
        yield

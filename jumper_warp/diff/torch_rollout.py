"""Rollouts as a function of PyTorch tensors, whose gradients come from the reverse pass of `Rollout`."""

from __future__ import annotations

import contextlib
from collections.abc import Container, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp
from torch.autograd.function import once_differentiable

from jumper_warp.diff.rollout import LATENCY_RANGE, Rollout, Trajectory
from jumper_warp.utils.checks import check_within
from jumper_warp.utils.errors import InputError

COMMANDS = ("targets", "q", "qd", "before", "wrench", "impulse")
OUTPUTS = ("q", "qd", "torque", "impulse", "safe")


class TorchTrajectory(NamedTuple):
    """A trajectory as tensors, see `Trajectory`; all carry gradients, for which nobody may change them in place."""

    q: torch.Tensor
    """(K + 1, 19, num_worlds)"""
    qd: torch.Tensor
    """(K + 1, 18, num_worlds)"""
    torque: torch.Tensor
    """(T S, 12, num_worlds) [N m]"""
    impulse: torch.Tensor
    """(T S, 4, num_worlds, 3) [N s]; divide by the physics step for the force."""
    safe: torch.Tensor
    """(T, 12, num_worlds) [rad]"""

    def end(self) -> dict[str, torch.Tensor]:
        """Return what `simulate` is given to go on from here, `impulse` without gradients."""
        return {"q": self.q[-1], "qd": self.qd[-1], "before": self.safe[-1], "impulse": self.impulse[-1].detach()}


def simulate(
    rollout: Rollout,
    targets: torch.Tensor,
    q: torch.Tensor,
    qd: torch.Tensor,
    *,
    before: torch.Tensor | None = None,
    wrench: torch.Tensor | None = None,
    impulse: torch.Tensor | None = None,
    trusted: bool = False,
    **parameters: torch.Tensor,
) -> TorchTrajectory:
    """Run a rollout; first derivatives reach all tensors but `impulse`.

    Shapes as in `Rollout.run`, with worlds or without them. parameters: entries of `Rollout.parameters`, which are
    written to the rollout and stay there, or `geometry` (4, 10) [m], the legs' lengths of all worlds; gradients by them
    are of the calls that they are given to. trusted: do not look at the numbers; of those on a GPU a latency alone is
    looked at, and waited for, as in `Rollout.run`.

    A policy that sees the state runs one policy step a call, each from `end()` of the one before. Raises InputError for
    a parameter of another name, what is no tensor of the shape or not finite, or a latency outside of `LATENCY_RANGE`;
    its reverse pass for a parameter that another call has changed meanwhile, and this one was not given.
    """
    named = {"targets": targets, "q": q, "qd": qd, "before": before, "wrench": wrench} | parameters
    given: dict[str, Any] = {
        name: tensor for name, tensor in named.items() if tensor is not None or name in COMMANDS[:3]
    }
    for name, tensor in given.items() if impulse is None else [*given.items(), ("impulse", impulse)]:
        if not isinstance(tensor, torch.Tensor):
            raise InputError(f"{name} must be a torch tensor, got {type(tensor).__name__}")
        if tensor.is_complex():
            raise InputError(f"{name} must be of real numbers, got {tensor.dtype}")
    if targets.dim() == 0:
        raise InputError("targets must have shape (T, 12, num_worlds), got ()")
    unknown = next((name for name in parameters if name not in rollout.parameters and name != "geometry"), None)
    if unknown is not None:
        raise InputError(
            f"a rollout has no parameter {unknown!r:.60}; it has {', '.join(rollout.parameters)}, geometry"
        )
    shapes = {"targets": (len(targets), 12), "q": (19,), "qd": (18,), "before": (12,), "wrench": (len(targets), 6)}
    shapes |= {name: array.shape[:-1] for name, array in rollout.parameters.items()}
    real = torch.float64 if rollout.real is wp.float64 else torch.float32
    for name, tensor in given.items():
        full = (4, 10) if name == "geometry" else (*shapes[name], rollout.num_worlds)
        if name != "geometry" and tuple(tensor.shape) == tuple(shapes[name]):
            tensor = tensor.unsqueeze(-1).expand(full)
        if tuple(tensor.shape) != full:
            raise InputError(f"{name} must have shape {full}, got {tuple(tensor.shape)}")
        given[name] = tensor.to(dtype=real).contiguous()
    given.setdefault("before", given["q"][7:].contiguous())
    if impulse is not None:
        if tuple(impulse.shape) != (4, rollout.num_worlds, 3):
            raise InputError(f"impulse must have shape {(4, rollout.num_worlds, 3)}, got {tuple(impulse.shape)}")
        impulse = impulse.detach().to(dtype=real).contiguous()
    if not trusted:
        _check_numbers(given if impulse is None else given | {"impulse": impulse})
    return TorchTrajectory(*_Simulate.apply(rollout, tuple(given), impulse, *given.values()))


def _check_numbers(given: dict[str, torch.Tensor]) -> None:
    """Raise InputError for a latency that is none, on a CPU for what is not finite, of parameters for NaN."""
    if "latency" in given:
        check_within("latency [s]", given["latency"].detach().cpu().numpy(), LATENCY_RANGE)
    for name, tensor in given.items():
        fits = tensor.is_cuda or (tensor.isfinite() if name in COMMANDS else ~tensor.isnan()).all()
        if not fits:
            raise InputError(f"{name} must be finite")


class _Simulate(torch.autograd.Function):
    """`Rollout.run` and `Rollout.backward`."""

    @staticmethod
    def forward(ctx: Any, rollout: Rollout, names: tuple[str, ...], impulse: Any, *tensors: torch.Tensor) -> tuple:
        """Run the rollout."""
        with _stream(rollout):
            given = dict(zip(names, tensors, strict=True))
            _write_parameters(rollout, given)
            commands = {name: wp.from_torch(given[name].detach()) for name in COMMANDS if name in given}
            if impulse is not None:
                commands["impulse"] = wp.from_torch(impulse, dtype=rollout.dynamics.modules.scalar.vec3)
            trajectory = rollout.run(**commands)
        ctx.rollout, ctx.names, ctx.trajectory, ctx.writes = rollout, names, trajectory, dict(rollout.writes)
        outputs = [wp.to_torch(getattr(trajectory, name)) for name in OUTPUTS]
        ctx.save_for_backward(*tensors, *outputs)  # the latter so that torch tells when they have been changed in place
        ctx.set_materialize_grads(False)
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: torch.Tensor | None) -> tuple:
        """Run it backwards, with the parameters that it had."""
        rollout, trajectory = ctx.rollout, ctx.trajectory
        given = dict(zip(ctx.names, ctx.saved_tensors, strict=False))
        changed = {name for name, count in rollout.writes.items() if ctx.writes[name] != count}
        if lost := changed - given.keys():
            raise InputError(f"{min(lost)} has been changed since this rollout: give it to each call of simulate")
        with _stream(rollout):
            _write_parameters(rollout, given, changed)
            seeds = {name: _seed(trajectory, name, grad) for name, grad in zip(OUTPUTS, grads, strict=False)}
            found = rollout.backward(trajectory, **seeds)
            sums = []
            for name in ctx.names:
                grad = wp.to_torch(found[name].contiguous())
                sums.append(grad.sum(-1) if name == "geometry" else grad)
        return (None, None, None, *sums)


def _seed(trajectory: Trajectory, name: str, grad: torch.Tensor | None) -> wp.array | None:
    """Return a gradient by an output of the trajectory as Warp sees it."""
    if grad is None:
        return None
    return wp.from_torch(grad.detach().contiguous(), dtype=getattr(trajectory, name).dtype)


def _write_parameters(rollout: Rollout, given: dict[str, torch.Tensor], new: Container[str] | None = None) -> None:
    """Write what is given of the parameters to the rollout; new: those that it does not hold yet, by default all."""
    for name, tensor in given.items():
        if name in rollout.writes and (new is None or name in new):
            rollout.writes[name] += 1
        if name in rollout.parameters:
            wp.copy(rollout.parameters[name], wp.from_torch(tensor.detach()))
        elif name == "geometry":
            rollout.set_geometry(tensor.detach().cpu().numpy().astype(np.float64))


@contextlib.contextmanager
def _stream(rollout: Rollout) -> Iterator[None]:
    """Let Warp work on PyTorch's stream.

    Warp forgets a stream, its own too, when a `wp.Stream` that wraps it is deleted, and captures no graph on it any
    more: where PyTorch works on Warp's stream, as it does beside an environment, nothing is wrapped.
    """
    device = rollout.device
    if not device.is_cuda or torch.cuda.current_stream().cuda_stream == wp.get_stream(device).cuda_stream:
        yield
        return
    with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream()), sync_enter=False):
        yield

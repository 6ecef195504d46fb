"""The reverse pass of a rollout where a thread has a leg: a few rows at a time, in three launches."""

from __future__ import annotations

from typing import Any

import warp as wp

from jumper_warp.sim.dynamics import JumperDynamics

SPAN = 4
"""Rows whose steps are taken at a time."""
RECORDS = 2
"""Spans whose steps are kept at a time."""


class LegReverse:
    """Launches `kernels.dynamics.rollout_legs_adjoint` and `constants_adjoint`.

    Few threads run the steps backwards. On a GPU they do so on a stream of their own, beside those that make the steps
    of an earlier span again and those that add gradients by constants for a later one.
    """

    def __init__(self, dynamics: JumperDynamics, every: int):
        """Allocate; every: physics steps from row to row."""
        self._dynamics, self._modules = dynamics, dynamics.modules
        self._device, self._num = dynamics.model.device, dynamics.model.world_count
        self._records = [self._record(SPAN * (every + 1)) for _ in range(RECORDS)]
        self._ahead = wp.Stream(self._device, priority=-1) if self._device.is_cuda else None

    def _record(self, entries: int) -> Any:
        module, shape = self._modules.leg_record, {"dtype": self._dynamics.real, "device": self._device}
        record = module.LegRecord()
        record.base = wp.zeros((entries, int(module.BASE_FIELDS), self._num), **shape)
        record.legs = wp.zeros((entries, int(module.LEG_FIELDS), self._num, 4), **shape)
        return record

    def run(self, settings: Any, motion: list[Any], seeds: Any, gradients: Any) -> None:
        """Add to `gradients`, whose q and qd hold the seeds of the last row.

        settings: `StepSettings`. motion: `Timing`, `Actuation`, `Commands`, filtered targets, `Rows` of the rollout.
        seeds: gradient by these rows.
        """
        last, spans = motion[-1].q.shape[0] - 1, []
        for end in range(last, 0, -SPAN):
            span = self._modules.rollout_legs_adjoint.Span()
            span.begin, span.end = max(0, end - SPAN), end
            spans.append(span)
        turns = 8 if self._device.is_cuda else 1  # a warp of a GPU has eight worlds, or eight steps of one
        threads = -(-self._num // 8) * 8
        kernels = self._modules.rollout_legs_adjoint

        constants_kernel = self._modules.constants_adjoint.constants_kernel

        def launch(kernel: wp.Kernel, dim: tuple[int, ...], inputs: list[Any], outputs: list[Any]) -> None:
            inputs = [inputs[0], self._dynamics.robot, settings, *motion, *inputs[1:]]
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._device, block_dim=4 * turns)

        def replay(number: int) -> None:
            span, record = spans[number], self._records[number % RECORDS]
            launch(kernels.replay_legs_kernel, (span.end - span.begin, threads, 4), [self._num, span], [record])

        def reverse(number: int) -> None:
            outputs = [self._records[number % RECORDS], gradients]
            launch(kernels.reverse_legs_kernel, (threads, 4), [self._num, seeds, spans[number]], outputs)

        def add_constants(number: int) -> None:
            outputs = [self._records[number % RECORDS], gradients]
            launch(constants_kernel, (self._num, turns, 4), [turns, seeds, spans[number]], outputs)

        if self._ahead is None:
            for number in range(len(spans)):
                replay(number)
                reverse(number)
                add_constants(number)
            return
        stream, replayed = wp.get_stream(self._device), []
        for number in range(len(spans) + RECORDS):
            if number >= RECORDS:
                now = number - RECORDS
                self._ahead.wait_event(replayed[now])
                with wp.ScopedStream(self._ahead, sync_enter=False):
                    reverse(now)
                stream.wait_event(self._ahead.record_event())
                add_constants(now)
            if number < len(spans):
                replay(number)
                replayed.append(stream.record_event())

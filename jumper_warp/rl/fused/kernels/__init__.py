"""Triton kernels of PPO's rollout and update, listed in the order in which an iteration runs them.

`rollout` acts and records, `layers` evaluates the networks, `losses` computes the losses and the gradients of the
outputs, `layers` those of inputs and weights, and `optimiser` sums them and runs Adam.

Matrices are row-major and contiguous. Widths of layers are multiples of 16. A product accumulates in float32; its
factors have the type of their arrays, bfloat16 on a GPU. No kernel uses atomics, so results repeat bitwise: a sum over
samples is written as one partial sum per split of the samples, and `optimiser.sum_partials` adds the splits in a fixed
order.
"""

from jumper_warp.rl.fused.kernels.layers import (
    layer_backward,
    layer_forward,
    network_backward,
    network_forward,
    weight_gradients,
)
from jumper_warp.rl.fused.kernels.losses import actor_loss, critic_loss
from jumper_warp.rl.fused.kernels.optimiser import adam_step, prepare_step, sum_partials
from jumper_warp.rl.fused.kernels.rollout import observe, record_step, sample_action

__all__ = [
    "actor_loss",
    "adam_step",
    "critic_loss",
    "layer_backward",
    "layer_forward",
    "network_backward",
    "network_forward",
    "observe",
    "prepare_step",
    "record_step",
    "sample_action",
    "sum_partials",
    "weight_gradients",
]

"""Triton kernels of PPO's rollout and update, listed in the order in which an iteration runs them.

`rollout` acts and records, `layers` evaluates the networks, `losses` computes the losses and the gradients of the
outputs, `layers` those of inputs and weights, and `optimiser` sums them and runs Adam.

Matrices are row-major and contiguous. Widths of layers are multiples of 16. A product accumulates in float32; its
factors have the type of their arrays, bfloat16 on a GPU. No kernel uses atomics, so results repeat bitwise: a sum over
samples is written as one partial sum per split of the samples, and `optimiser.sum_partials` adds the splits in a fixed
order.
"""

"""Triton kernels that add up partial sums of the gradients, and take a step of Adam.

Parameters, gradient and moments are flat vectors, the actor's part first (`jumper_warp.rl.flat`). The layers' kernels
read a padded copy of the parameters, `weights`, in which a symmetric actor has its first layer once for each image;
`table` has each parameter's places in it. Splits: parts of the samples, added in a fixed order so that results repeat
bitwise.
"""

import triton
import triton.language as tl

from jumper_warp.rl.fused.kernels.scalar import INFINITY, finite_or_zero

LOG_BETA_1 = tl.constexpr(-0.10536051565782628)  # log of 0.9, decay of the first moment in `torch.optim.Adam`
LOG_BETA_2 = tl.constexpr(-0.0010005003335835335)


@triton.jit
def sum_partials(partial, table, gradient, stride, total, SPLITS: tl.constexpr, IMAGES: tl.constexpr, B: tl.constexpr):
    """Add up the gradients of all parts (splits) of the samples in a fixed order; write the flat gradient (total,).

    partial: (SPLITS, stride), the gradient of each split.
    table: (2 IMAGES - 1, total) of `FusedLayout`, the entry that a parameter has in `partial`, and another entry with a
    sign for each further image.
    """
    i = tl.program_id(0) * B + tl.arange(0, B)
    place = partial + tl.load(table + i, mask=i < total, other=0)
    grad = tl.zeros((B,), tl.float32)
    for split in tl.static_range(SPLITS):
        grad += tl.load(place + split * stride)
    for image in tl.static_range(1, IMAGES):
        place = partial + tl.load(table + (2 * image - 1) * total + i, mask=i < total, other=0)
        mirrored = tl.zeros((B,), tl.float32)
        for split in tl.static_range(SPLITS):
            mirrored += tl.load(place + split * stride)
        grad += tl.load(table + 2 * image * total + i, mask=i < total, other=0).to(tl.float32) * mirrored
    tl.store(gradient + i, grad, mask=i < total)


@triton.jit
def prepare_step(
    gradient, squares, lr, num_steps, factors, desired_kl, size, actor_size, min_lr, max_lr, ADAPT: tl.constexpr,
    B: tl.constexpr,
):  # fmt: skip
    """Prepare a step of Adam: adapt the learning rate, and write the gradient's sum of squares per block of entries.

    squares: (blocks, 2), of actor and critic.
    gradient: (size + 32,), the last entry is the KL divergence. lr, num_steps: () of `FlatAdam`; the rate adapts as in
    `flat.adapted_lr`. factors: (2,) Adam's factors of both moments in this step.
    """
    block = tl.program_id(0)
    i = block * B + tl.arange(0, B)
    grad = tl.load(gradient + i, mask=i < size, other=0.0)
    tl.store(squares + 2 * block, tl.sum(tl.where(i < actor_size, grad * grad, 0.0), 0))
    tl.store(squares + 2 * block + 1, tl.sum(tl.where(i < actor_size, 0.0, grad * grad), 0))
    if block == 0:
        rate = tl.load(lr)
        step = tl.load(num_steps) + 1.0
        if ADAPT:
            kl, desired = tl.load(gradient + size + 31), tl.load(desired_kl)
            reduced = tl.where(kl > 2.0 * desired, tl.maximum(rate / 1.5, min_lr), rate)
            rate = tl.where((kl < 0.5 * desired) & (kl > 1.0e-6 * desired), tl.minimum(rate * 1.5, max_lr), reduced)
        double = step.to(tl.float64)  # 1 - beta^step cancels in float32
        tl.store(lr, rate)
        tl.store(num_steps, step)
        tl.store(factors, rate / (1.0 - tl.exp(double * LOG_BETA_1)).to(tl.float32))
        tl.store(factors + 1, 1.0 / tl.sqrt(1.0 - tl.exp(double * LOG_BETA_2)).to(tl.float32))


@triton.jit
def adam_step(
    value, gradient, exp_avg, exp_avg_sq, squares, factors, weights, table, sums, size, actor_size, max_norm,
    BLOCKS: tl.constexpr, NUM_SQUARES: tl.constexpr, IMAGES: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Clip the gradient, update parameters and moments by a step of Adam, and add losses and gradient norms to `sums`.

    gradient: (size + 32,), then surrogate, value loss, entropy, and the KL divergence as the last entry.
    squares (NUM_SQUARES, 2), factors (2,): of `prepare_step`; BLOCKS: power of two, at least NUM_SQUARES. weights: the
    copy of the parameters for products; table: (2 IMAGES - 1, size + 32) of `FusedLayout`, entries of each parameter in
    `weights`, and signs. sums: (8,) losses, KL, norms of actor and critic, skipped steps, steps. A non-finite gradient
    counts as 0.
    """
    block = tl.arange(0, BLOCKS)
    actor = tl.sqrt(tl.sum(tl.load(squares + 2 * block, mask=block < NUM_SQUARES, other=0.0), 0))
    critic = tl.sqrt(tl.sum(tl.load(squares + 2 * block + 1, mask=block < NUM_SQUARES, other=0.0), 0))
    i = tl.program_id(0) * B + tl.arange(0, B)
    mask = i < size
    norm = tl.where(i < actor_size, actor, critic)
    scale = tl.minimum(max_norm / (norm + 1.0e-6), 1.0)
    grad = tl.where(norm < INFINITY, tl.load(gradient + i, mask=mask, other=0.0) * scale, 0.0)
    first = tl.load(exp_avg + i, mask=mask, other=0.0)
    first += 0.1 * (grad - first)
    second = 0.999 * tl.load(exp_avg_sq + i, mask=mask, other=0.0) + 0.001 * grad * grad
    root = tl.sqrt(second) * tl.load(factors + 1) + 1.0e-8
    new = tl.load(value + i, mask=mask, other=0.0) - first / root * tl.load(factors)
    tl.store(exp_avg + i, first, mask=mask)
    tl.store(exp_avg_sq + i, second, mask=mask)
    tl.store(value + i, new, mask=mask)
    dtype = weights.dtype.element_ty
    tl.store(weights + tl.load(table + i, mask=mask, other=0), new.to(dtype), mask=mask)
    for image in tl.static_range(1, IMAGES):
        total = size + 32
        sign = tl.load(table + 2 * image * total + i, mask=mask, other=0).to(tl.float32)
        place = tl.load(table + (2 * image - 1) * total + i, mask=mask, other=0)
        tl.store(weights + place, (new * sign).to(dtype), mask=mask & (sign != 0.0))
    if tl.program_id(0) == 0:
        loss = gradient + size
        skipped = tl.where((actor < INFINITY) & (critic < INFINITY), 0.0, 1.0)
        for j in tl.static_range(3):  # surrogate, value, entropy
            tl.store(sums + j, tl.load(sums + j) + finite_or_zero(tl.load(loss + j)))
        tl.store(sums + 3, tl.load(sums + 3) + finite_or_zero(tl.load(loss + 31)))
        tl.store(sums + 4, tl.load(sums + 4) + finite_or_zero(actor))
        tl.store(sums + 5, tl.load(sums + 5) + finite_or_zero(critic))
        tl.store(sums + 6, tl.load(sums + 6) + skipped)
        tl.store(sums + 7, tl.load(sums + 7) + 1.0)

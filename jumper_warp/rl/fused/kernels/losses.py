"""Triton kernels of the policy's mean action, and of the losses of actor and critic with their gradients.

The policy is Gaussian: mean action of the network, standard deviations exp(log_std). A symmetric actor has the mean of
network outputs for images of the observation (`jumper_warp.rl.mirror`). A row of `samples` is action (num_actions),
mean (num_actions), then log probability, value, advantage and return. Samples are divided into splits, whose sums are
added later in a fixed order. Sums of losses are in places 0 surrogate, 1 value, 2 entropy and 31 KL of `loss_partial`.
"""

import triton
import triton.language as tl

from jumper_warp.rl.fused.kernels.scalar import HALF_LOG_TAU


@triton.jit
def policy_mean(output, mirror, row, action, mask, width, IMAGES: tl.constexpr):
    """Return the policy's mean action, (len(row), len(action)): the mean of the images of the network's outputs.

    output: of the network, rows IMAGES i and following those of sample i, for each image of its observation. mirror:
    (IMAGES, 2, width) order and signs of the actions' images.
    """
    base = output + (IMAGES * row).to(tl.int64)[:, None] * width
    mean = tl.zeros((row.shape[0], action.shape[0]), tl.float32)
    for image in tl.static_range(IMAGES):
        order = tl.load(mirror + 2 * image * width + action).to(tl.int32)
        sign = tl.load(mirror + (2 * image + 1) * width + action)
        mean += tl.load(base + image * width + order[None, :], mask=mask, other=0.0) * sign[None, :]
    return mean / IMAGES


@triton.jit
def actor_loss(
    output, mirror, samples, sample_width, index, log_std, old_log_std, entropy_coef, grad_output, noise_partial,
    loss_partial, stride, rows, rows_per_split, num_actions, clip, IMAGES: tl.constexpr, WIDTH: tl.constexpr,
    BM: tl.constexpr,
):  # fmt: skip
    """Write PPO's actor losses, and their gradients with respect to the network's output and the exploration noise.

    Losses: see `jumper_warp.rl.torch.ppo.ppo_losses`, whose gradient autograd computes there.
    output, grad_output: (IMAGES rows, WIDTH), as in `policy_mean`. samples: (…, sample_width), of which the rows
    `index` are taken. noise_partial: (num_actions,) and loss_partial: surrogate, -, entropy, KL, sums over each split
    as in `layers.weight_gradients`.
    """
    split, action = tl.program_id(0), tl.arange(0, WIDTH)
    first = split * rows_per_split
    last = tl.minimum(first + rows_per_split, rows)
    used = action < num_actions
    new, old = tl.load(log_std + action, mask=used, other=0.0), tl.load(old_log_std + action, mask=used, other=0.0)
    precision = tl.exp(-new)
    grad_noise = tl.zeros((WIDTH,), tl.float32)
    surrogate, kl = tl.zeros((BM,), tl.float32), tl.zeros((BM,), tl.float32)
    for start in range(first, last, BM):
        row = start + tl.arange(0, BM)
        inside = row < last
        mask = inside[:, None] & used[None, :]
        mean = policy_mean(output, mirror, row, action, mask, WIDTH, IMAGES)
        sample = samples + tl.load(index + row, mask=inside, other=0) * sample_width
        chosen = tl.load(sample[:, None] + action[None, :], mask=mask, other=0.0)
        old_mean = tl.load(sample[:, None] + num_actions + action[None, :], mask=mask, other=0.0)
        old_log_prob = tl.load(sample + 2 * num_actions, mask=inside, other=0.0)
        advantage = tl.load(sample + 2 * num_actions + 2, mask=inside, other=0.0)
        z = tl.where(mask, (chosen - mean) * precision[None, :], 0.0)
        log_prob = tl.sum(tl.where(mask, -0.5 * z * z - new[None, :] - HALF_LOG_TAU, 0.0), 1)
        ratio = tl.exp(log_prob - old_log_prob)
        objective = advantage * ratio
        clipped = advantage * tl.minimum(tl.maximum(ratio, 1.0 - clip), 1.0 + clip)
        grad = tl.where(inside & (objective <= clipped), -objective / rows, 0.0)
        grad = tl.where(objective == objective, grad, objective)  # NaN must reach the gradient, which is then skipped
        grad_noise += tl.sum(tl.where(mask, grad[:, None] * (z * z - 1.0), 0.0), 0)
        grad_mean = grad[:, None] * z * precision[None, :]
        place = grad_output + (IMAGES * row).to(tl.int64)[:, None] * WIDTH
        for image in tl.static_range(IMAGES):
            order = tl.load(mirror + 2 * image * WIDTH + action).to(tl.int32)
            part = grad_mean * (tl.load(mirror + (2 * image + 1) * WIDTH + action) / IMAGES)[None, :]
            part = part.to(grad_output.dtype.element_ty)
            tl.store(place + image * WIDTH + order[None, :], part, mask=inside[:, None])
        shift = tl.where(mask, (old_mean - mean) * precision[None, :], 0.0)
        surrogate -= tl.where(inside, tl.minimum(objective, clipped), 0.0)
        divergence = new - old + 0.5 * (tl.exp(2.0 * (old - new)) - 1.0)
        kl += tl.sum(tl.where(mask, divergence[None, :] + 0.5 * shift * shift, 0.0), 1)
    is_first = tl.where(split == 0, 1.0, 0.0)
    grad_noise -= is_first * tl.load(entropy_coef)
    tl.store(noise_partial + split * stride + action, grad_noise, mask=used)
    loss = loss_partial + split * stride
    tl.store(loss, tl.sum(surrogate, 0) / rows)
    tl.store(loss + 2, is_first * tl.sum(tl.where(used, new + HALF_LOG_TAU + 0.5, 0.0), 0))
    tl.store(loss + 31, tl.sum(kl, 0) / rows)


@triton.jit
def critic_loss(
    output, samples, sample_width, index, grad_output, loss_partial, stride, rows, rows_per_split, num_actions, clip,
    weight, CLIP_VALUE: tl.constexpr, WIDTH: tl.constexpr, BM: tl.constexpr,
):  # fmt: skip
    """Write PPO's value loss, and its gradient with respect to the critic's output.

    Loss: see `jumper_warp.rl.torch.ppo.ppo_losses`, whose gradient autograd computes there.
    output, grad_output: (rows, WIDTH), of which column 0 counts; samples, index, loss_partial: as in `actor_loss`.
    """
    split, col = tl.program_id(0), tl.arange(0, WIDTH)
    first = split * rows_per_split
    last = tl.minimum(first + rows_per_split, rows)
    total = tl.zeros((BM,), tl.float32)
    for start in range(first, last, BM):
        row = start + tl.arange(0, BM)
        inside = row < last
        new = tl.load(output + row.to(tl.int64) * WIDTH, mask=inside, other=0.0)
        sample = samples + tl.load(index + row, mask=inside, other=0) * sample_width + 2 * num_actions
        value = tl.load(sample + 1, mask=inside, other=0.0)
        target = tl.load(sample + 3, mask=inside, other=0.0)
        grad = new - target
        loss = grad * grad
        if CLIP_VALUE:
            change = new - value
            error = value + tl.minimum(tl.maximum(change, -clip), clip) - target
            free = tl.where(tl.abs(change) <= clip, error, 0.0)
            grad = tl.where(error * error > loss, free, grad)
            loss = tl.where(error * error > loss, error * error, loss)
        total += loss
        place = grad_output + row.to(tl.int64)[:, None] * WIDTH + col[None, :]
        scaled = tl.where((col == 0)[None, :], (grad * (2.0 * weight / rows))[:, None], 0.0)
        tl.store(place, scaled.to(grad_output.dtype.element_ty), mask=inside[:, None])
    tl.store(loss_partial + split * stride + 1, tl.sum(total, 0) / rows)

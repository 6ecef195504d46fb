"""Triton kernels of a policy step in a rollout: normalise observations, sample actions, record results.

Rows are worlds. Sums about the present mean, not about 0, keep the variance exact in single precision.
"""

import triton
import triton.language as tl

from jumper_warp.rl.fused.kernels.losses import policy_mean
from jumper_warp.rl.fused.kernels.scalar import HALF_LOG_TAU, finite_or_zero


@triton.jit(do_not_specialize=["row_stride", "num_obs"], do_not_specialize_on_alignment=["obs"])
def observe(
    obs, row_stride, col_stride, mean, std, features, moments, rows, num_obs, width, limit,
    BM: tl.constexpr, BN: tl.constexpr,
):  # fmt: skip
    """Write normalised, zero-padded observations, (rows, width), and sums for mean and variance of the raw ones.

    obs: (rows, num_obs) raw; mean, std: (num_obs,). moments: (blocks, 2, width) sums
    of the difference from `mean`, and of its square.
    """
    row = tl.program_id(0) * BM + tl.arange(0, BM)
    col = tl.program_id(1) * BN + tl.arange(0, BN)
    valid = (row < rows)[:, None] & (col < num_obs)[None, :]
    raw = tl.load(obs + row.to(tl.int64)[:, None] * row_stride + col[None, :] * col_stride, mask=valid, other=0.0)
    difference = raw - tl.load(mean + col, mask=col < num_obs, other=0.0)[None, :]
    scaled = difference / tl.load(std + col, mask=col < num_obs, other=1.0)[None, :]
    scaled = tl.where(valid, tl.minimum(tl.maximum(scaled, -limit), limit), 0.0)
    place = features + row.to(tl.int64)[:, None] * width + col[None, :]
    tl.store(place, scaled.to(features.dtype.element_ty), mask=(row < rows)[:, None] & (col < width)[None, :])
    difference = tl.where(valid, difference, 0.0)
    sums = moments + tl.program_id(0) * 2 * width + col
    tl.store(sums, tl.sum(difference, 0), mask=col < width)
    tl.store(sums + width, tl.sum(difference * difference, 0), mask=col < width)


@triton.jit
def sample_action(
    output, mirror, log_std, action, samples, rows, num_actions, sample_width, IMAGES: tl.constexpr,
    WIDTH: tl.constexpr, BM: tl.constexpr,
):  # fmt: skip
    """Sample actions and write them to `action`; write actions, their means and log probabilities to `samples`.

    output, mirror: as in `policy_mean`; action: (rows, num_actions), standard normal noise on entry; samples: (rows,
    sample_width).
    """
    row, col = tl.program_id(0) * BM + tl.arange(0, BM), tl.arange(0, WIDTH)
    mask = (row < rows)[:, None] & (col < num_actions)[None, :]
    mean = policy_mean(output, mirror, row, col, mask, WIDTH, IMAGES)
    log_scale = tl.load(log_std + col, mask=col < num_actions, other=0.0)
    place = action + row[:, None] * num_actions + col[None, :]
    chosen = tl.load(place, mask=mask, other=0.0) * tl.exp(log_scale)[None, :] + mean
    tl.store(place, chosen, mask=mask)
    z = (chosen - mean) * tl.exp(-log_scale)[None, :]
    log_prob = tl.sum(tl.where(mask, -0.5 * z * z - log_scale[None, :] - HALF_LOG_TAU, 0.0), 1)
    sample = samples + row * sample_width
    tl.store(sample[:, None] + col[None, :], chosen, mask=mask)
    tl.store(sample[:, None] + num_actions + col[None, :], mean, mask=mask)
    tl.store(sample + 2 * num_actions, log_prob, mask=row < rows)


@triton.jit
def record_step(reward, done, timeout, rewards, dones, timeouts, episode, finished, rows, scale, B: tl.constexpr):
    """Write a step's reward, done and timeout, (rows,) each, to the rollout; update the episodes' returns and lengths.

    episode: (2, rows) and finished: (3, rows), float64, as in `Collector`.
    """
    i = tl.program_id(0) * B + tl.arange(0, B)
    mask = i < rows
    gain = finite_or_zero(tl.load(reward + i, mask=mask, other=0.0))
    end = tl.load(done + i, mask=mask, other=0.0)
    tl.store(rewards + i, gain * scale, mask=mask)
    tl.store(dones + i, end, mask=mask)
    tl.store(timeouts + i, tl.load(timeout + i, mask=mask, other=0.0), mask=mask)
    end = end.to(tl.float64)
    total = tl.load(episode + i, mask=mask, other=0.0) + gain
    length = tl.load(episode + rows + i, mask=mask, other=0.0) + 1.0
    tl.store(finished + i, tl.load(finished + i, mask=mask, other=0.0) + total * end, mask=mask)
    tl.store(finished + rows + i, tl.load(finished + rows + i, mask=mask, other=0.0) + length * end, mask=mask)
    tl.store(finished + 2 * rows + i, tl.load(finished + 2 * rows + i, mask=mask, other=0.0) + end, mask=mask)
    tl.store(episode + i, total * (1.0 - end), mask=mask)
    tl.store(episode + rows + i, length * (1.0 - end), mask=mask)

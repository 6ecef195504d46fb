"""Triton kernels of the fused update: layers forward and backward, losses, sums in a fixed order, and Adam.

Matrices are row-major and contiguous. Widths of layers are multiples of 16. A product accumulates in float32; its
factors have the type of their arrays, bfloat16 on a GPU. No kernel uses atomics, so results repeat bitwise: a sum over
samples is written as one partial sum per split of the samples, and `sum_partials` adds the splits in a fixed order.

Indices: row of a matrix is the sample. Tiles: BM rows, BN columns, BK terms of a product per pass.
"""

import triton
import triton.language as tl

HALF_LOG_TAU = tl.constexpr(0.9189385332046727)  # log(2 π) / 2
LOG_BETA_1 = tl.constexpr(-0.10536051565782628)  # log of `flat.BETAS`
LOG_BETA_2 = tl.constexpr(-0.0010005003335835335)
INFINITY = tl.constexpr(float("inf"))


@triton.jit
def finite_or_zero(x):
    """Return x with NaN and infinite entries set to 0."""
    return tl.where(tl.abs(x) < INFINITY, x, 0.0)


# ---------------------------------------------------------------- layers


@triton.jit(do_not_specialize=["num_bias"])
def layer_forward(
    x, index, weight, bias, y, rows, num_in, num_out, num_bias, GATHER: tl.constexpr, ELU: tl.constexpr,
    BM: tl.constexpr, BN: tl.constexpr, BK: tl.constexpr,
):  # fmt: skip
    """Write y = x Wᵀ + b, with ELU if requested, (rows, num_out).

    x: (…, num_in), of which GATHER takes the rows `index`; weight: (num_out, num_in); bias: (num_bias,), repeated.
    """
    row = tl.program_id(0) * BM + tl.arange(0, BM)
    col = tl.program_id(1) * BN + tl.arange(0, BN)
    source = row.to(tl.int64)
    if GATHER:
        source = tl.load(index + row, mask=row < rows, other=0)
    acc = tl.zeros((BM, BN), tl.float32)
    for start in range(0, num_in, BK):
        k = start + tl.arange(0, BK)
        mask = (row < rows)[:, None] & (k < num_in)[None, :]
        a = tl.load(x + source[:, None] * num_in + k[None, :], mask=mask, other=0.0)
        mask = (k < num_in)[:, None] & (col < num_out)[None, :]
        acc = tl.dot(a, tl.load(weight + col[None, :] * num_in + k[:, None], mask=mask, other=0.0), acc)
    acc += tl.load(bias + col % num_bias)[None, :]
    if ELU:
        acc = tl.where(acc > 0.0, acc, tl.exp(acc) - 1.0)
    out = y + row.to(tl.int64)[:, None] * num_out + col[None, :]
    tl.store(out, acc.to(y.dtype.element_ty), mask=(row < rows)[:, None] & (col < num_out)[None, :])


@triton.jit
def layer_backward(
    grad_out, weight, y, grad_in, rows, num_in, num_out, BM: tl.constexpr, BN: tl.constexpr, BK: tl.constexpr
):
    """Write the gradient with respect to a layer's input before its ELU, (grad_out W) elu', (rows, num_in).

    grad_out: (rows, num_out); weight: (num_out, num_in); y: (rows, num_in) the input, elu' = 1 + min(y, 0).
    """
    row = tl.program_id(0) * BM + tl.arange(0, BM)
    col = tl.program_id(1) * BN + tl.arange(0, BN)
    acc = tl.zeros((BM, BN), tl.float32)
    for start in range(0, num_out, BK):
        k = start + tl.arange(0, BK)
        mask = (row < rows)[:, None] & (k < num_out)[None, :]
        a = tl.load(grad_out + row.to(tl.int64)[:, None] * num_out + k[None, :], mask=mask, other=0.0)
        mask = (k < num_out)[:, None] & (col < num_in)[None, :]
        acc = tl.dot(a, tl.load(weight + k[:, None] * num_in + col[None, :], mask=mask, other=0.0), acc)
    place = row.to(tl.int64)[:, None] * num_in + col[None, :]
    mask = (row < rows)[:, None] & (col < num_in)[None, :]
    slope = 1.0 + tl.minimum(tl.load(y + place, mask=mask, other=0.0).to(tl.float32), 0.0)
    tl.store(grad_in + place, (acc * slope).to(grad_in.dtype.element_ty), mask=mask)


@triton.jit
def network_forward(
    x, index, weights, value, outputs, rows, LAYERS: tl.constexpr, BIASES: tl.constexpr, PADDED: tl.constexpr,
    GATHER: tl.constexpr, BM: tl.constexpr, BK: tl.constexpr,
):  # fmt: skip
    """Write the outputs of all layers of a network, without GATHER of the last only; a block keeps its rows.

    x, index, GATHER: as in `layer_forward`; value: flat vector of the parameters; outputs: of each layer. LAYERS: of
    each layer its weight's place in `weights`, its bias' place there, num_in, num_out and rows per sample; BIASES: its
    bias' place in `value` and number of entries; PADDED: powers of two, num_out at least.
    """
    row = tl.program_id(0) * BM + tl.arange(0, BM)
    source = row.to(tl.int64)
    if GATHER:
        source = tl.load(index + row, mask=row < rows, other=0)
    num_in: tl.constexpr = LAYERS[0][2]
    width: tl.constexpr = PADDED[0]
    col = tl.arange(0, width)
    acc = tl.zeros((BM, width), tl.float32)
    for start in range(0, num_in, BK):
        k = start + tl.arange(0, BK)
        mask = (row < rows)[:, None] & (k < num_in)[None, :]
        a = tl.load(x + source[:, None] * num_in + k[None, :], mask=mask, other=0.0)
        mask = (k < num_in)[:, None] & (col < LAYERS[0][3])[None, :]
        w = tl.load(weights + LAYERS[0][0] + col[None, :] * num_in + k[:, None], mask=mask, other=0.0)
        acc = tl.dot(a, w, acc)
    h = acc
    for i in tl.static_range(len(LAYERS)):
        if i > 0:
            if LAYERS[i][4] > LAYERS[i - 1][4]:  # the mirrored half of each row is a row of its own
                row = tl.program_id(0) * (2 * BM) + tl.arange(0, 2 * BM)
                h = tl.reshape(h, (2 * BM, width // 2))
            k = tl.arange(0, PADDED[i - 1] // (LAYERS[i][4] // LAYERS[i - 1][4]))
            col = tl.arange(0, PADDED[i])
            mask = (k < LAYERS[i][2])[:, None] & (col < LAYERS[i][3])[None, :]
            w = tl.load(weights + LAYERS[i][0] + col[None, :] * LAYERS[i][2] + k[:, None], mask=mask, other=0.0)
            acc = tl.dot(h, w)
        acc += tl.load(value + BIASES[i][0] + col % BIASES[i][1], mask=col < LAYERS[i][3], other=0.0)[None, :]
        if i < len(LAYERS) - 1:
            h = tl.where(acc > 0.0, acc, tl.exp(acc) - 1.0).to(x.dtype.element_ty)
        else:
            h = acc
        if GATHER or i == len(LAYERS) - 1:
            out = outputs[i] + row.to(tl.int64)[:, None] * LAYERS[i][3] + col[None, :]
            tl.store(out, h, mask=(row < rows * LAYERS[i][4])[:, None] & (col < LAYERS[i][3])[None, :])


@triton.jit
def network_backward(grad_outs, weights, outputs, rows, LAYERS: tl.constexpr, PADDED: tl.constexpr, BM: tl.constexpr):
    """Write the gradients with respect to the outputs of all layers but the last, before their ELU.

    grad_outs: of each layer, (rows, num_out), the last one is given; others: as in `network_forward`.
    """
    row = tl.program_id(0) * BM + tl.arange(0, BM)
    col = tl.arange(0, PADDED[len(LAYERS) - 1])
    place = grad_outs[len(LAYERS) - 1] + row.to(tl.int64)[:, None] * LAYERS[len(LAYERS) - 1][3] + col[None, :]
    grad = tl.load(place, mask=(row < rows)[:, None] & (col < LAYERS[len(LAYERS) - 1][3])[None, :], other=0.0)
    for j in tl.static_range(len(LAYERS) - 1):
        grad = input_gradient(
            grad, weights + LAYERS[len(LAYERS) - 1 - j][0], outputs[len(LAYERS) - 2 - j],
            grad_outs[len(LAYERS) - 2 - j], row, rows, LAYERS[len(LAYERS) - 1 - j][2], LAYERS[len(LAYERS) - 1 - j][3],
            PADDED[len(LAYERS) - 1 - j],
            PADDED[len(LAYERS) - 2 - j] // (LAYERS[len(LAYERS) - 1 - j][4] // LAYERS[len(LAYERS) - 2 - j][4]),
        )  # fmt: skip


@triton.jit
def input_gradient(
    grad, weight, y, grad_in, row, rows, NUM_IN: tl.constexpr, NUM_OUT: tl.constexpr, BK: tl.constexpr,
    BN: tl.constexpr,
):  # fmt: skip
    """Write and return the gradient of `layer_backward` for the rows `row`; grad: (len(row), BK)."""
    k, col = tl.arange(0, BK), tl.arange(0, BN)
    place = weight + k[:, None] * NUM_IN + col[None, :]
    acc = tl.dot(grad, tl.load(place, mask=(k < NUM_OUT)[:, None] & (col < NUM_IN)[None, :], other=0.0))
    mask = (row < rows)[:, None] & (col < NUM_IN)[None, :]
    place = row.to(tl.int64)[:, None] * NUM_IN + col[None, :]
    slope = 1.0 + tl.minimum(tl.load(y + place, mask=mask, other=0.0).to(tl.float32), 0.0)
    grad = (acc * slope).to(grad_in.dtype.element_ty)
    tl.store(grad_in + place, grad, mask=mask)
    return grad


@triton.jit
def weight_gradients(
    grad_outs, inputs, index, partial, stride, rows, rows_per_split, LAYERS: tl.constexpr, TILES: tl.constexpr,
    BK: tl.constexpr,
):  # fmt: skip
    """Write the sums over each split of the rows of grad_outᵀ x (num_out, num_in) and of grad_out, of all layers.

    grad_outs, inputs: gradient with respect to a layer's output and its input x, (…, num_out) and (…, num_in); the
    first x has `rows` rows, of which the rows `index` are taken. partial: (SPLITS, stride), in the places of LAYERS, as
    in `network_forward`. TILES: of each layer, its first tile, the next layer's first tile, BM and BN.
    """
    tile = tl.program_id(0)
    for i in tl.static_range(len(LAYERS)):
        if (tile >= TILES[i][0]) & (tile < TILES[i][1]):
            weight_gradient_tile(
                grad_outs[i], inputs[i], index, partial, stride, rows, rows_per_split, tile - TILES[i][0], LAYERS[i][0],
                LAYERS[i][1], LAYERS[i][2], LAYERS[i][3], LAYERS[i][4], i == 0, TILES[i][2], TILES[i][3], BK,
            )  # fmt: skip


@triton.jit
def weight_gradient_tile(
    grad_out, x, index, partial, stride, rows, rows_per_split, tile, WEIGHT: tl.constexpr, BIAS: tl.constexpr,
    NUM_IN: tl.constexpr, NUM_OUT: tl.constexpr, REPEAT: tl.constexpr, GATHER: tl.constexpr, BM: tl.constexpr,
    BN: tl.constexpr, BK: tl.constexpr,
):  # fmt: skip
    """Write a tile of `weight_gradients`; the tiles of a layer are numbered along the rows of its weight first."""
    tiles: tl.constexpr = (NUM_OUT + BM - 1) // BM
    out = (tile % tiles) * BM + tl.arange(0, BM)
    col = (tile // tiles) * BN + tl.arange(0, BN)
    first = tl.program_id(1) * rows_per_split * REPEAT
    last = tl.minimum(first + rows_per_split * REPEAT, rows * REPEAT)
    acc = tl.zeros((BM, BN), tl.float32)
    bias = tl.zeros((BM, 16), tl.float32)
    ones = tl.full((BK, 16), 1.0, grad_out.dtype.element_ty)
    for start in range(first, last, BK):
        row = start + tl.arange(0, BK)
        source = row.to(tl.int64)
        if GATHER:
            source = tl.load(index + row, mask=row < last, other=0)
        mask = (row < last)[None, :] & (out < NUM_OUT)[:, None]
        a = tl.load(grad_out + row.to(tl.int64)[None, :] * NUM_OUT + out[:, None], mask=mask, other=0.0)
        mask = (row < last)[:, None] & (col < NUM_IN)[None, :]
        acc = tl.dot(a, tl.load(x + source[:, None] * NUM_IN + col[None, :], mask=mask, other=0.0), acc)
        bias = tl.dot(a, ones, bias)
    place = partial + tl.program_id(1) * stride
    weight = place + WEIGHT + out[:, None] * NUM_IN + col[None, :]
    tl.store(weight, acc, mask=(out < NUM_OUT)[:, None] & (col < NUM_IN)[None, :])
    if tile < tiles:
        column = tl.arange(0, 16)[None, :]
        tl.store((place + BIAS + out)[:, None] + 0 * column, bias, mask=(out < NUM_OUT)[:, None] & (column == 0))


# ---------------------------------------------------------------- losses


@triton.jit
def policy_mean(output, mirror, row, action, mask, width, MIRROR: tl.constexpr):
    """Return the policy's mean action and f(x) - N f(M x) for rows of the network's output; (len(row), len(action)).

    MIRROR: rows 2 i and 2 i + 1 of `output` are f(x) and f(M x) of row i; mirror: (2, width) order and signs of N.
    """
    if MIRROR:
        order = tl.load(mirror + action).to(tl.int32)
        sign = tl.load(mirror + width + action)
        base = output + (2 * row).to(tl.int64)[:, None] * width
        direct = tl.load(base + action[None, :], mask=mask, other=0.0)
        image = tl.load(base + width + order[None, :], mask=mask, other=0.0) * sign[None, :]
        return 0.5 * (direct + image), direct - image
    mean = tl.load(output + row.to(tl.int64)[:, None] * width + action[None, :], mask=mask, other=0.0)
    return mean, tl.zeros_like(mean)


@triton.jit
def actor_loss(
    output, mirror, samples, sample_width, index, log_std, old_log_std, entropy_coef, grad_output, noise_partial,
    loss_partial, stride, rows, rows_per_split, num_actions, clip, MIRROR: tl.constexpr, WIDTH: tl.constexpr,
    BM: tl.constexpr,
):  # fmt: skip
    """Write the gradients of `ppo.actor_gradient`'s loss with respect to output and noise, and the losses.

    output, grad_output: (rows, WIDTH), twice the rows with MIRROR, as in `policy_mean`. samples: (…, sample_width), of
    which the rows `index` are taken. noise_partial: (num_actions,) and loss_partial: surrogate, -, entropy, asymmetry,
    KL, sums over each split as in `weight_gradient`.
    """
    split, action = tl.program_id(0), tl.arange(0, WIDTH)
    first = split * rows_per_split
    last = tl.minimum(first + rows_per_split, rows)
    used = action < num_actions
    new, old = tl.load(log_std + action, mask=used, other=0.0), tl.load(old_log_std + action, mask=used, other=0.0)
    precision = tl.exp(-new)
    grad_noise = tl.zeros((WIDTH,), tl.float32)
    surrogate, asymmetry, kl = tl.zeros((BM,), tl.float32), tl.zeros((BM,), tl.float32), tl.zeros((BM,), tl.float32)
    for start in range(first, last, BM):
        row = start + tl.arange(0, BM)
        inside = row < last
        mask = inside[:, None] & used[None, :]
        mean, difference = policy_mean(output, mirror, row, action, mask, WIDTH, MIRROR)
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
        if MIRROR:
            order = tl.load(mirror + action).to(tl.int32)
            sign = tl.load(mirror + WIDTH + action)
            place = grad_output + (2 * row).to(tl.int64)[:, None] * WIDTH
            half, image = 0.5 * grad_mean, 0.5 * grad_mean * sign[None, :]
            tl.store(place + action[None, :], half.to(grad_output.dtype.element_ty), mask=inside[:, None])
            tl.store(place + WIDTH + order[None, :], image.to(grad_output.dtype.element_ty), mask=inside[:, None])
        else:
            place = grad_output + row.to(tl.int64)[:, None] * WIDTH + action[None, :]
            tl.store(place, grad_mean.to(grad_output.dtype.element_ty), mask=inside[:, None])
        shift = tl.where(mask, (old_mean - mean) * precision[None, :], 0.0)
        surrogate -= tl.where(inside, tl.minimum(objective, clipped), 0.0)
        asymmetry += tl.sum(tl.where(mask, difference * difference, 0.0), 1)
        divergence = new - old + 0.5 * (tl.exp(2.0 * (old - new)) - 1.0)
        kl += tl.sum(tl.where(mask, divergence[None, :] + 0.5 * shift * shift, 0.0), 1)
    is_first = tl.where(split == 0, 1.0, 0.0)
    grad_noise -= is_first * tl.load(entropy_coef)
    tl.store(noise_partial + split * stride + action, grad_noise, mask=used)
    loss = loss_partial + split * stride
    tl.store(loss, tl.sum(surrogate, 0) / rows)
    tl.store(loss + 2, is_first * tl.sum(tl.where(used, new + HALF_LOG_TAU + 0.5, 0.0), 0))
    tl.store(loss + 3, tl.sum(asymmetry, 0) / (rows * num_actions))
    tl.store(loss + 31, tl.sum(kl, 0) / rows)


@triton.jit
def critic_loss(
    output, samples, sample_width, index, grad_output, loss_partial, stride, rows, rows_per_split, num_actions, clip,
    weight, CLIP_VALUE: tl.constexpr, WIDTH: tl.constexpr, BM: tl.constexpr,
):  # fmt: skip
    """Write the gradient of `ppo.critic_gradient`'s loss with respect to the output, and the value loss.

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


# ---------------------------------------------------------------- optimiser


@triton.jit
def sum_partials(partial, table, gradient, stride, total, SPLITS: tl.constexpr, MIRROR: tl.constexpr, B: tl.constexpr):
    """Write the flat gradient (total,), the sums of the splits in `partial` (SPLITS, stride), always in one order.

    table: (3, total) of `FusedLayout`, the entry that a parameter has in `partial`, that of its mirror image, the sign.
    """
    i = tl.program_id(0) * B + tl.arange(0, B)
    place = partial + tl.load(table + i, mask=i < total, other=0)
    image = partial + tl.load(table + total + i, mask=(i < total) & MIRROR, other=0)
    sign = tl.load(table + 2 * total + i, mask=(i < total) & MIRROR, other=0).to(tl.float32)
    grad = tl.zeros((B,), tl.float32)
    for split in tl.static_range(SPLITS):
        grad += tl.load(place + split * stride)
        if MIRROR:
            grad += sign * tl.load(image + split * stride)
    tl.store(gradient + i, grad, mask=i < total)


@triton.jit
def prepare_step(
    gradient, squares, lr, num_steps, factors, desired_kl, size, actor_size, min_lr, max_lr, ADAPT: tl.constexpr,
    B: tl.constexpr,
):  # fmt: skip
    """Write sums of squares of the gradient by block, (blocks, 2) of actor and critic, and the step's learning rate.

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
    BLOCKS: tl.constexpr, NUM_SQUARES: tl.constexpr, MIRROR: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Clip the gradient, update parameters and moments by a step of Adam, and add the statistics to `sums`.

    gradient, squares, factors: of `prepare_step`, NUM_SQUARES blocks, a power of two BLOCKS at least. weights: the
    copy of the parameters for products, in the places of `table` (3, size + 32). A non-finite gradient counts as 0.
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
    if MIRROR:
        total = size + 32
        sign = tl.load(table + 2 * total + i, mask=mask, other=0).to(tl.float32)
        place = tl.load(table + total + i, mask=mask, other=0)
        tl.store(weights + place, (new * sign).to(dtype), mask=mask & (sign != 0.0))
    if tl.program_id(0) == 0:
        loss = gradient + size
        skipped = tl.where((actor < INFINITY) & (critic < INFINITY), 0.0, 1.0)
        for j in tl.static_range(4):  # surrogate, value, entropy, asymmetry
            tl.store(sums + j, tl.load(sums + j) + finite_or_zero(tl.load(loss + j)))
        tl.store(sums + 4, tl.load(sums + 4) + finite_or_zero(tl.load(loss + 31)))
        tl.store(sums + 5, tl.load(sums + 5) + finite_or_zero(actor))
        tl.store(sums + 6, tl.load(sums + 6) + finite_or_zero(critic))
        tl.store(sums + 7, tl.load(sums + 7) + skipped)
        tl.store(sums + 8, tl.load(sums + 8) + 1.0)


# ---------------------------------------------------------------- collection


@triton.jit(do_not_specialize=["row_stride", "num_obs"], do_not_specialize_on_alignment=["obs"])
def observe(
    obs, row_stride, col_stride, mean, std, features, moments, rows, num_obs, width, raw_limit, limit,
    BM: tl.constexpr, BN: tl.constexpr,
):  # fmt: skip
    """Write normalised, zero-padded observations, (rows, width), and sums over blocks of rows for their moments.

    obs: (rows, num_obs) raw, sanitised as `vec_env.sanitise`; mean, std: (num_obs,). moments: (blocks, 2, width) sums
    of the difference from `mean`, and of its square.
    """
    row = tl.program_id(0) * BM + tl.arange(0, BM)
    col = tl.program_id(1) * BN + tl.arange(0, BN)
    valid = (row < rows)[:, None] & (col < num_obs)[None, :]
    raw = tl.load(obs + row.to(tl.int64)[:, None] * row_stride + col[None, :] * col_stride, mask=valid, other=0.0)
    raw = tl.minimum(tl.maximum(finite_or_zero(raw), -raw_limit), raw_limit)
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
    output, mirror, log_std, action, samples, rows, num_actions, sample_width, MIRROR: tl.constexpr,
    WIDTH: tl.constexpr, BM: tl.constexpr,
):  # fmt: skip
    """Write the sampled action, and action, mean and log probability to the samples of one step, (rows, sample_width).

    output, mirror: as in `policy_mean`; action: (rows, num_actions), standard normal noise on entry.
    """
    row, col = tl.program_id(0) * BM + tl.arange(0, BM), tl.arange(0, WIDTH)
    mask = (row < rows)[:, None] & (col < num_actions)[None, :]
    mean, _ = policy_mean(output, mirror, row, col, mask, WIDTH, MIRROR)
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
def record_step(
    reward, done, timeout, rewards, dones, timeouts, episode, finished, rows, scale, B: tl.constexpr
):  # fmt: skip
    """Write a step's reward, done and timeout, (rows,) each, to the rollout, and update the counts of episodes.

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

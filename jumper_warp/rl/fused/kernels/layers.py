"""Triton kernels of layers and whole networks: forward and backward pass, and gradients of the weights.

Tiles: BM rows, BN columns, BK terms of a product per pass. A row is a sample. Each program of a launch computes one
tile; masks cut off what lies beyond the matrices. ELU: x for x > 0, else exp(x) - 1; its slope follows from its output
y alone, 1 + min(y, 0), so that inputs of layers need not be stored twice.
"""

import triton
import triton.language as tl

WEIGHT, BIAS, INPUTS, OUTPUTS, REPEAT = (tl.constexpr(i) for i in range(5))
"""Entries of a layer in LAYERS: places of weight and bias in the padded vector, widths, and rows per sample."""


@triton.jit(do_not_specialize=["num_bias"])
def layer_forward(
    x, index, weight, bias, y, rows, num_in, num_out, num_bias, GATHER: tl.constexpr, ELU: tl.constexpr,
    BM: tl.constexpr, BN: tl.constexpr, BK: tl.constexpr,
):  # fmt: skip
    """Compute the output of one network layer, y = x Wᵀ + b, with an optional ELU; write it to y (rows, num_out).

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
    """Backpropagate a gradient through a linear layer and the ELU before it; write it to grad_in (rows, num_in).

    The result is (grad_out W) elu' with elu' = 1 + min(y, 0). grad_out: (rows, num_out); weight: (num_out, num_in); y:
    (rows, num_in) the layer's input.
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
    """Evaluate a network; write the output of its last layer or, with GATHER, the outputs of all its layers.

    A block keeps its rows in registers from layer to layer, which saves writing and reading them; the update (GATHER)
    needs all outputs for the backward pass.
    x, index, GATHER: as in `layer_forward`; value: flat vector of the parameters; outputs: of each layer. LAYERS: the
    layers, the first first; BIASES: of each its bias' place in `value` and number of entries; PADDED: powers of two,
    not less than its width.
    """
    row = tl.program_id(0) * BM + tl.arange(0, BM)
    source = row.to(tl.int64)
    if GATHER:
        source = tl.load(index + row, mask=row < rows, other=0)
    num_in: tl.constexpr = LAYERS[0][INPUTS]
    width: tl.constexpr = PADDED[0]
    col = tl.arange(0, width)
    acc = tl.zeros((BM, width), tl.float32)
    for start in range(0, num_in, BK):
        k = start + tl.arange(0, BK)
        mask = (row < rows)[:, None] & (k < num_in)[None, :]
        a = tl.load(x + source[:, None] * num_in + k[None, :], mask=mask, other=0.0)
        mask = (k < num_in)[:, None] & (col < LAYERS[0][OUTPUTS])[None, :]
        w = tl.load(weights + LAYERS[0][WEIGHT] + col[None, :] * num_in + k[:, None], mask=mask, other=0.0)
        acc = tl.dot(a, w, acc)
    h = acc
    for i in tl.static_range(len(LAYERS)):
        if i > 0:
            if LAYERS[i][REPEAT] > LAYERS[i - 1][REPEAT]:  # each image in a row becomes a row of its own
                row = tl.program_id(0) * (LAYERS[i][REPEAT] * BM) + tl.arange(0, LAYERS[i][REPEAT] * BM)
                h = tl.reshape(h, (LAYERS[i][REPEAT] * BM, width // LAYERS[i][REPEAT]))
            k = tl.arange(0, PADDED[i - 1] // (LAYERS[i][REPEAT] // LAYERS[i - 1][REPEAT]))
            col = tl.arange(0, PADDED[i])
            mask = (k < LAYERS[i][INPUTS])[:, None] & (col < LAYERS[i][OUTPUTS])[None, :]
            w = tl.load(
                weights + LAYERS[i][WEIGHT] + col[None, :] * LAYERS[i][INPUTS] + k[:, None], mask=mask, other=0.0
            )
            acc = tl.dot(h, w)
        acc += tl.load(value + BIASES[i][0] + col % BIASES[i][1], mask=col < LAYERS[i][OUTPUTS], other=0.0)[None, :]
        if i < len(LAYERS) - 1:
            h = tl.where(acc > 0.0, acc, tl.exp(acc) - 1.0).to(x.dtype.element_ty)
        else:
            h = acc
        if GATHER or i == len(LAYERS) - 1:
            out = outputs[i] + row.to(tl.int64)[:, None] * LAYERS[i][OUTPUTS] + col[None, :]
            tl.store(out, h, mask=(row < rows * LAYERS[i][REPEAT])[:, None] & (col < LAYERS[i][OUTPUTS])[None, :])


@triton.jit
def network_backward(grad_outs, weights, outputs, rows, LAYERS: tl.constexpr, PADDED: tl.constexpr, BM: tl.constexpr):
    """Backpropagate through a network: write the gradients with respect to the pre-activations of its hidden layers.

    As in `network_forward`, but all sequences have the last layer first. grad_outs: of each layer, (rows, num_out), of
    which that of the last layer is given.
    """
    row = tl.program_id(0) * BM + tl.arange(0, BM)
    col = tl.arange(0, PADDED[0])
    place = grad_outs[0] + row.to(tl.int64)[:, None] * LAYERS[0][OUTPUTS] + col[None, :]
    grad = tl.load(place, mask=(row < rows)[:, None] & (col < LAYERS[0][OUTPUTS])[None, :], other=0.0)
    for i in tl.static_range(len(LAYERS) - 1):
        grad = input_gradient(
            grad, weights + LAYERS[i][WEIGHT], outputs[i + 1], grad_outs[i + 1], row, rows, LAYERS[i][INPUTS],
            LAYERS[i][OUTPUTS], PADDED[i], PADDED[i + 1] // (LAYERS[i][REPEAT] // LAYERS[i + 1][REPEAT]),
        )  # fmt: skip


@triton.jit
def input_gradient(
    grad, weight, y, grad_in, row, rows, NUM_IN: tl.constexpr, NUM_OUT: tl.constexpr, BK: tl.constexpr,
    BN: tl.constexpr,
):  # fmt: skip
    """Backpropagate `grad` (len(row), BK) through a layer and the ELU before it, to `grad_in`; return the result."""
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
    """Write the gradients of all layers' weights (grad_outᵀ x) and biases (Σ grad_out), one sum per split of samples.

    grad_outs, inputs: gradient with respect to a layer's output and its input x, (…, num_out) and (…, num_in); the
    first x has `rows` rows, of which the rows `index` are taken. partial: (SPLITS, stride), in the places of LAYERS.
    TILES: of each layer, its first tile, the next layer's first tile, BM and BN.
    """
    tile = tl.program_id(0)
    for i in tl.static_range(len(LAYERS)):
        if (tile >= TILES[i][0]) & (tile < TILES[i][1]):
            weight_gradient_tile(
                grad_outs[i], inputs[i], index, partial, stride, rows, rows_per_split, tile - TILES[i][0], LAYERS, i,
                TILES[i][2], TILES[i][3], BK,
            )  # fmt: skip


@triton.jit
def weight_gradient_tile(
    grad_out, x, index, partial, stride, rows, rows_per_split, tile, LAYERS: tl.constexpr, LAYER: tl.constexpr,
    BM: tl.constexpr, BN: tl.constexpr, BK: tl.constexpr,
):  # fmt: skip
    """Write one tile of a layer's weight gradient and bias gradient, summed over one part (split) of the samples.

    Arguments: see `weight_gradients`.
    tile: number within the layer, counted along the rows of the weight first. The bias gradient is a product with
    ones, since only products sum over samples in tensor cores; 16 is their smallest width, and all columns are equal.
    """
    num_in: tl.constexpr = LAYERS[LAYER][INPUTS]
    num_out: tl.constexpr = LAYERS[LAYER][OUTPUTS]
    repeat: tl.constexpr = LAYERS[LAYER][REPEAT]
    tiles: tl.constexpr = (num_out + BM - 1) // BM
    out = (tile % tiles) * BM + tl.arange(0, BM)
    col = (tile // tiles) * BN + tl.arange(0, BN)
    first = tl.program_id(1) * rows_per_split * repeat
    last = tl.minimum(first + rows_per_split * repeat, rows * repeat)
    acc = tl.zeros((BM, BN), tl.float32)
    bias = tl.zeros((BM, 16), tl.float32)
    ones = tl.full((BK, 16), 1.0, grad_out.dtype.element_ty)
    for start in range(first, last, BK):
        row = start + tl.arange(0, BK)
        source = row.to(tl.int64)
        if LAYER == 0:
            source = tl.load(index + row, mask=row < last, other=0)
        mask = (row < last)[None, :] & (out < num_out)[:, None]
        a = tl.load(grad_out + row.to(tl.int64)[None, :] * num_out + out[:, None], mask=mask, other=0.0)
        mask = (row < last)[:, None] & (col < num_in)[None, :]
        acc = tl.dot(a, tl.load(x + source[:, None] * num_in + col[None, :], mask=mask, other=0.0), acc)
        bias = tl.dot(a, ones, bias)
    place = partial + tl.program_id(1) * stride
    weight = place + LAYERS[LAYER][WEIGHT] + out[:, None] * num_in + col[None, :]
    tl.store(weight, acc, mask=(out < num_out)[:, None] & (col < num_in)[None, :])
    if tile < tiles:
        column = tl.arange(0, 16)[None, :]
        tl.store(
            (place + LAYERS[LAYER][BIAS] + out)[:, None] + 0 * column,
            bias,
            mask=(out < num_out)[:, None] & (column == 0),
        )

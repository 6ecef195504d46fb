"""Actor and critic for the fused kernels: padded copies of the weights, activations, gradients and their partial sums.

A symmetric actor evaluates its network for k images M x of an observation (`jumper_warp.rl.mirror`). As W (M x) = (W M)
x, its first layer has the weights W M below each other: its output (rows, k width) is, in memory, the input (k rows,
width) of the next layer. The table of `FusedLayout` ties the weights: W's gradient is the sum of all blocks' gradients.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import torch

from jumper_warp.rl.flat import ALIGNMENT, FlatParameters, Segment, aligned
from jumper_warp.rl.fused.kernels import layers as kernels
from jumper_warp.rl.mirror import MirrorMap, images
from jumper_warp.rl.networks import ActorCritic
from jumper_warp.utils.threads import available_threads

WIDTH = 16  # Widths of layers are padded to a multiple of this, the smallest tile of a matrix product
INPUT_WIDTH = 32  # Widths of observations are padded to a multiple of this
MOST_SPLITS = 32  # Largest number of splits of the samples whose sums are added in a fixed order; a power of two
SPLIT_ROWS = 512  # Smallest number of samples in a split; shorter ones cost more for their partial sums than they save
MAX_WIDTH = 256  # Largest width of a layer for the kernels of all layers, whose blocks keep their rows in registers
Launch = Callable[..., Any]  # A kernel with its grid
_noted: list[tuple[Any, tuple, dict[str, Any]]] | None = None  # Kernels to compile, with arguments and options


class Layer(NamedTuple):
    """Location of a layer's weight and bias in the kernels' padded parameter vector, and the layer's padded widths.

    The kernels multiply tiles of fixed width, so that they need padded copies of the parameters (`FlatParameters`).
    """

    weight: int  # first entry of the weight (outputs, inputs)
    bias: int  # first entry of the bias (outputs,)
    inputs: int
    outputs: int
    parameter: Segment  # bias in `FlatParameters`


class FusedLayout:
    """Offsets of all parameters in the zero-padded vector of parameters that the fused kernels read.

    Padding makes all widths multiples of the tensor cores' tiles.

    Partial sums of the gradients have the same offsets.

    `table` (2 k - 1, size of `FlatParameters.all_reduced`) int32 has for every entry of the flat vector its place in
    the padded vector, and for each further image of the first layer place and sign; 0 is a place that nothing uses.
    """

    def __init__(self, flat: FlatParameters, obs: MirrorMap) -> None:
        """Assign places to actor, noise, critic and losses; obs: images of the observation for the actor, (k, n)."""
        self.size = WIDTH
        self._flat = flat
        self._table = torch.zeros(2 * len(obs.order) - 1, flat.all_reduced.numel(), dtype=torch.int64)
        count = len(flat.segments) // 2  # parameters of the actor, as many as of the critic; the noise is between
        self.actor = self._network(flat.segments[:count], obs)
        noise = flat.segments[count]
        self.noise = self._place(noise.start + torch.arange(noise.shape[0]))
        self.critic = self._network(flat.segments[count + 1 :], None)
        self.losses = self._place(flat.size + torch.arange(ALIGNMENT))
        self.table = self._table.to(flat.value.device, torch.int32)

    def _place(self, index: torch.Tensor) -> int:
        """Assign places in the padded vector to the entries `index` of the flat vector; return the first place."""
        start = self.size
        self._table[0, index] = start + torch.arange(len(index))
        self.size += aligned(len(index), WIDTH)
        return start

    def _network(self, segments: list[Segment], obs: MirrorMap | None) -> list[Layer]:
        """Assign places to a network's layers; obs: images of the observation, for each of which is a first layer."""
        layers = []
        for weight, bias in zip(segments[::2], segments[1::2], strict=True):
            (num_out, num_in), first = weight.shape, not layers
            maps = [*zip(*obs, strict=True)][1:] if first and obs else []
            outputs = (1 + len(maps)) * num_out
            layer = Layer(
                self.size, self.size + aligned(outputs, WIDTH) * aligned(num_in, INPUT_WIDTH if first else WIDTH),
                aligned(num_in, INPUT_WIDTH if first else WIDTH), aligned(outputs, WIDTH), bias,
            )  # fmt: skip
            self.size = layer.bias + layer.outputs
            out, col = torch.arange(num_out)[:, None], torch.arange(num_in)[None, :]
            index = weight.start + out * num_in + col
            self._table[0, index] = layer.weight + out * layer.inputs + col
            self._table[0, bias.start + out[:, 0]] = layer.bias + out[:, 0]
            for image, (order, signs) in enumerate(maps, 1):
                rows = image * num_out + out
                self._table[2 * image - 1, index] = layer.weight + rows * layer.inputs + order[col]
                self._table[2 * image, index] = signs[col].to(torch.int64).expand(num_out, -1)
                self._table[2 * image - 1, bias.start + out[:, 0]] = layer.bias + rows[:, 0]
                self._table[2 * image, bias.start + out[:, 0]] = 1
            layers.append(layer)
        return layers

    def copy_weights(self, weights: torch.Tensor) -> None:
        """Copy the parameters from the flat vector to the kernels' padded vector (size,)."""
        value, (place, *others) = self._flat.value, self.table[:, : self._flat.size].to(torch.int64)
        for image, sign in zip(others[::2], others[1::2], strict=True):
            weights[image] = (sign * value).to(weights.dtype)
        weights[place] = value.to(weights.dtype)


class FusedModel:
    """Actor and critic for the fused kernels, with a padded copy of the weights of an `ActorCritic`."""

    def __init__(self, model: ActorCritic, flat: FlatParameters, rows: int, dtype: torch.dtype) -> None:
        """Allocate networks for at most `rows` samples; dtype: of weights, activations and their gradients."""
        symmetries, device = model.symmetries, flat.value.device
        obs = images((each.obs for each in symmetries), len(model.obs_moments.mean))
        action = images((each.action for each in symmetries), len(model.log_std))
        self.images = len(obs.order)
        """Number of images of an observation for which the actor's network is evaluated."""
        self.layout = layout = FusedLayout(flat, obs)
        self.weights = torch.zeros(layout.size, dtype=dtype, device=device)
        self.splits = min(MOST_SPLITS, power_of_two(max(1, rows // SPLIT_ROWS)))
        """Number of splits of a minibatch."""
        self.partial = torch.zeros(self.splits, layout.size, device=device)
        """Sums over the splits of the samples, (splits, size of the layout)."""
        networks = (self.weights, self.partial, rows)
        self.actor = FusedNetwork(layout.actor, flat, *networks, self.images)
        self.critic = FusedNetwork(layout.critic, flat, *networks)
        padding = torch.stack([torch.arange(float(self.actor.width)), torch.ones(self.actor.width)])
        mirror = padding.repeat(self.images, 1, 1)
        mirror[:, :, : len(model.log_std)] = torch.stack([*action], dim=1)
        self.mirror = mirror.to(device)
        """Order and signs of the action's images, padded, (images, 2, width of the actor's output)."""

    def copy_weights(self) -> None:
        """Copy the current parameters of actor and critic to the padded vector that the kernels read."""
        self.layout.copy_weights(self.weights)


class FusedNetwork:
    """Forward and backward pass of actor or critic by the fused kernels, on at most `rows` samples at a time."""

    def __init__(
        self, layers: list[Layer], flat: FlatParameters, weights: torch.Tensor, partial: torch.Tensor, rows: int,
        images: int = 1,
    ) -> None:  # fmt: skip
        """Allocate activations.

        weights: (size of the layout,) copy of the parameters; partial: (splits, size); images: number of each sample's.
        """
        self._layers, self._weights, self._value, self._partial = layers, weights, flat.value, partial
        repeats = [images if i > 0 else 1 for i in range(len(layers))]  # rows of a layer for each sample
        self._rows_per_sample = repeats[-1]
        self._outputs, self._gradients = [], []
        for layer, repeat in zip(layers, repeats, strict=True):
            shape = (repeat * rows, layer.outputs)
            dtype = torch.float32 if layer is layers[-1] else weights.dtype
            self._outputs.append(weights.new_zeros(shape, dtype=dtype))
            self._gradients.append(weights.new_zeros(shape))
        self.output, self.grad_output = self._outputs[-1], self._gradients[-1]
        """The last layer's output, float32, and the loss gradient with respect to it, (rows per sample · rows, width).

        A symmetric actor has a row for each image of a sample.
        """
        self._places = tuple((*layer[:4], repeat) for layer, repeat in zip(layers, repeats, strict=True))
        self._biases = tuple((layer.parameter.start, layer.parameter.shape[0]) for layer in layers)
        self._padded = tuple(power_of_two(layer.outputs) for layer in layers)
        self._gradient_tiles = gradient_tiles(layers)
        width = self._padded[0] // self._rows_per_sample
        filled = self._padded[0] == layers[0].outputs or images == 1
        self._whole = filled and max(width, *self._padded[1:]) <= MAX_WIDTH
        """Whether one kernel evaluates all layers; a first layer of images must fill its padding."""

    @property
    def width(self) -> int:
        """Number of columns of the network's output, padding included."""
        return self._layers[-1].outputs

    def forward(self, x: torch.Tensor, rows: int, index: torch.Tensor | None = None) -> torch.Tensor:
        """Evaluate the network on normalised observations, write `output` and return it.

        With an index also write what `backward` needs.
        x: (…, padded width of the observation), the rows `index` of it if given, else the first `rows`.
        """
        gather, block = index is not None, 32 if self._layers[0].inputs % 64 else 64
        if self._whole:
            warps, bm = 4 if self._rows_per_sample == 1 else 8, 32 if self._rows_per_sample > 2 else 64
            launch(kernels.network_forward, (blocks(rows, bm),), num_warps=warps, num_stages=2)(
                x, index if gather else x, self._weights, self._value, tuple(self._outputs), rows, self._places,
                self._biases, self._padded, gather, bm, block,
            )  # fmt: skip
            return self.output
        for i, (layer, place) in enumerate(zip(self._layers, self._places, strict=True)):
            count, bn = place[4] * rows, min(power_of_two(layer.outputs), 128)
            launch(kernels.layer_forward, (blocks(count, 128), blocks(layer.outputs, bn)), num_warps=8)(
                x, index if gather else x, self._weights[layer.weight :], self._value[layer.parameter.start :],
                self._outputs[i], count, layer.inputs, layer.outputs, layer.parameter.shape[0], gather,
                i < len(self._layers) - 1, 128, bn, 32 if layer.inputs % 64 else 64,
            )  # fmt: skip
            x, gather = self._outputs[i], False
        return self.output

    def backward(self, x: torch.Tensor, rows: int, index: torch.Tensor) -> None:
        """Backpropagate `grad_output`; write all parameters' gradients as partial sums; arguments: as in `forward`."""
        count, gradients, outputs = self._rows_per_sample * rows, tuple(self._gradients), tuple(self._outputs)
        if self._whole:
            launch(kernels.network_backward, (blocks(count, 64),))(
                gradients[::-1], self._weights, outputs[::-1], count, self._places[::-1], self._padded[::-1], 64
            )
        else:
            for i in reversed(range(1, len(self._layers))):
                layer = self._layers[i]
                bn = min(power_of_two(layer.inputs), 128)
                launch(kernels.layer_backward, (blocks(count, 128), blocks(layer.inputs, bn)), num_warps=8)(
                    gradients[i], self._weights[layer.weight :], outputs[i - 1], gradients[i - 1], count, layer.inputs,
                    layer.outputs, 128, bn, min(power_of_two(layer.outputs), 64),
                )  # fmt: skip
        splits = len(self._partial)
        launch(kernels.weight_gradients, (self._gradient_tiles[-1][1], splits))(
            gradients, (x, *outputs[:-1]), index, self._partial, self._partial.stride(0), rows,
            rows_per_split(rows, splits),
            self._places, self._gradient_tiles, 64,
        )  # fmt: skip


def blocks(count: int, size: int) -> int:
    """Return the number of blocks of `size` entries that `count` entries need."""
    return -(-count // size)


def power_of_two(width: int) -> int:
    """Return the smallest power of two that is not less than a width."""
    return 1 << (width - 1).bit_length()


def gradient_tiles(layers: list[Layer]) -> tuple[tuple[int, int, int, int], ...]:
    """Return how each layer's weight gradient is divided into tiles: first tile, next layer's first tile, BM and BN.

    Tiles of BM x BN entries of all layers are numbered on, so that one launch computes the gradients of all layers.
    """
    tiles, count = [], 0
    for layer in layers:
        bm, bn = (min(power_of_two(width), 128) for width in (layer.outputs, layer.inputs))
        first, count = count, count + blocks(layer.outputs, bm) * blocks(layer.inputs, bn)
        tiles.append((first, count, bm, bn))
    return tuple(tiles)


def rows_per_split(rows: int, splits: int) -> int:
    """Return the number of samples in each of the splits (the last ones may have fewer) of a gradient's sum."""
    return aligned(blocks(rows, splits), WIDTH)


def launch(kernel: Any, grid: tuple[int, ...], num_warps: int = 4, num_stages: int = 3) -> Launch:
    """Return a function that launches a Triton kernel on a grid; its arguments are the kernel's.

    Within `compile_side_by_side` the function launches nothing, but notes the kernel. num_warps, num_stages: options
    of Triton's compiler.
    """
    options = {"num_warps": num_warps, "num_stages": num_stages}
    if (noted := _noted) is None:
        return lambda *args: kernel[grid](*args, **options)
    return lambda *args: noted.append((kernel, args, options | {"grid": grid}))


def compile_side_by_side(launches: Callable[[], object], device: torch.device) -> None:
    """Compile the kernels that a procedure launches, in several threads, without launching them.

    Errors of the compiler propagate.
    """
    global _noted
    _noted = []
    try:
        launches()
        variants = {(kernel, *map(_variant, args)): (kernel, args, options) for kernel, args, options in _noted}
    finally:
        _noted = None
    set_device = partial(torch.cuda.set_device, device) if device.type == "cuda" else None
    with ThreadPoolExecutor(available_threads(), initializer=set_device) as pool:
        jobs = [pool.submit(kernel.warmup, *args, **options) for kernel, args, options in variants.values()]
        for job in jobs:
            job.result()


def _variant(argument: Any) -> Any:
    """Return what Triton compiles a kernel for: the type of a tensor's entries, the value of another argument.

    Launches with equal variants share one compiled kernel.
    """
    return argument.dtype if isinstance(argument, torch.Tensor) else argument

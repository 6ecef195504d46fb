"""Kernel functions with loops over static expressions written out."""

import numpy as np
import warp as wp

from jumper_warp.kernels.mdp.factory import unrolled


@wp.func
def twice(x: float) -> float:
    return 2.0 * x


@wp.func
def square(x: float) -> float:
    return x * x


def accumulate_kernel(funcs, per_lane=2):
    """Return the Python function of a kernel that applies each of `funcs` in a lane's share of them."""

    def accumulate(lane: int, x: wp.array[float], out: wp.array[float]):
        i = wp.tid()
        for k in range(wp.static((len(funcs) + per_lane - 1) // per_lane)):
            if lane == k:
                for j in range(wp.static(k * per_lane), wp.static(min((k + 1) * per_lane, len(funcs)))):
                    out[i] = out[i] + wp.static(funcs[j])(x[i]) + float(j)
        for _ in range(2):
            out[i] = out[i] + 1.0

    return accumulate


def test_unrolled_kernel_computes_the_same_as_python():
    kernel = wp.kernel(unrolled(accumulate_kernel([twice, square, twice])), module="unique")
    x = wp.array([0.5, 3.0], dtype=float, device="cpu")
    outs = [wp.zeros(2, dtype=float, device="cpu") for _ in range(2)]
    for lane, out in enumerate(outs):
        wp.launch(kernel, 2, [lane, x, out], device="cpu")
    np.testing.assert_allclose(outs[0].numpy(), [1.0 + 0.25 + 1.0 + 2.0, 6.0 + 9.0 + 1.0 + 2.0])
    np.testing.assert_allclose(outs[1].numpy(), [1.0 + 2.0 + 2.0, 6.0 + 2.0 + 2.0])


def test_functions_that_differ_in_static_values_give_different_kernels():
    kernels = [wp.kernel(unrolled(accumulate_kernel(funcs)), module="unique") for funcs in ([twice], [square])]
    assert kernels[0].module.name != kernels[1].module.name

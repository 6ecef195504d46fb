"""Sine and cosine of one angle in one call, fast on GPUs: every physics step needs them for twelve motors."""

import warp as wp

from ..scalar import real, vec2

# On a GPU in single precision: the angle less its nearest multiple of pi/2, taken off in three parts, and minimax
# polynomials on [-pi/4, pi/4]; within 1.5 units in the last place up to 1e4 rad, and a fraction of the library's code.
_SNIPPET = """
#if defined(__CUDA_ARCH__)
    if constexpr (sizeof(x) == 4) {
        const float n = rintf(x * 0.636619772f);
        float r = fmaf(n, -1.5707962513e+0f, x);
        r = fmaf(n, -7.5497894159e-8f, r);
        r = fmaf(n, -5.3903029534e-15f, r);
        const float z = r * r;
        float s = fmaf(z, -1.9515295891e-4f, 8.3321608736e-3f);
        s = fmaf(fmaf(s, z, -1.6666654611e-1f) * z, r, r);
        float c = fmaf(z, 2.4433157118e-5f, -1.3887316255e-3f);
        c = fmaf(fmaf(c, z, 4.1666645683e-2f), z * z, fmaf(z, -0.5f, 1.0f));
        const int q = static_cast<int>(n);
        const float a = (q & 1) ? c : s;
        const float b = (q & 1) ? s : c;
        return { (q & 2) ? -a : a, ((q + 1) & 2) ? -b : b };
    }
#endif
    return { wp::sin(x), wp::cos(x) };
"""
_ADJOINT = "adj_x += adj_ret[0] * wp::cos(x) - adj_ret[1] * wp::sin(x);"


@wp.func_native(_SNIPPET, _ADJOINT)
def sin_cos(x: real) -> vec2:
    """Return (sine, cosine) of an angle [rad]; kernels run the C++ code `_SNIPPET` instead of this Python body."""
    return vec2(wp.sin(x), wp.cos(x))

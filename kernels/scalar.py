"""Scalar type of the physics kernels, and the small vectors and matrices made of it.

Every function of the robot's physics is written in terms of `real`. The package is single precision;
`jumper_warp.sim.precision.float64_kernels()` loads the same files a second time under the name
`jumper_warp.kernels_float64`, where `real` is double precision: the reference for rounding and for gradients. Numbers
in kernels are written `real(0.5)`, as Warp converts no types implicitly.
"""

import warp as wp

real = wp.float64 if __package__ == "jumper_warp.kernels_float64" else wp.float32

vec2 = wp.types.vector(length=2, dtype=real)
vec3 = wp.types.vector(length=3, dtype=real)
vec4 = wp.types.vector(length=4, dtype=real)
vec5 = wp.types.vector(length=5, dtype=real)
vec6 = wp.types.vector(length=6, dtype=real)
quat = wp.types.quaternion(dtype=real)
mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
mat43 = wp.types.matrix(shape=(4, 3), dtype=real)

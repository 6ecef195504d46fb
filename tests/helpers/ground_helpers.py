"""Heights of heightfields, by NumPy and by the solver's kernel function."""

from dataclasses import replace

import numpy as np
import warp as wp

from jumper_warp.kernels.terrain import ground as ground_module
from jumper_warp.kernels.terrain.ground import Ground, surface
from jumper_warp.robot.model import build_model
from jumper_warp.sim.model_parts import find_ground, ground_struct

wp.set_module_options({"enable_backward": False})


def hardest(task):
    """Return a copy of the task with only the hardest row of its terrain map; tasks without a map are unchanged."""
    settings = task.reset.settings
    terrain = getattr(settings, "terrain", None)
    if terrain is None or terrain.rows == 0:
        return task
    return replace(task, reset=replace(task.reset, settings=replace(settings, terrain=replace(terrain, rows=1))))


def heights(field):
    """Return the heights of the nodes [m], rows along y."""
    return field.min_z + np.asarray(field.data, dtype=float) * (field.max_z - field.min_z)


@wp.kernel
def surface_kernel(ground: Ground, x: wp.array(dtype=float), y: wp.array(dtype=float), out: wp.array(dtype=wp.vec3)):
    """Write what `surface` returns at positions x, y [m] to out; one thread per position."""
    i = wp.tid()
    out[i] = surface(ground, x[i], y[i])


def probe(field, x, y):
    """Return height [m] and slopes of the ground by the solver's `surface`, (n, 3); x, y [m]: (n,)."""
    model = build_model(1, ground=field, visuals=False, device="cpu")
    ground = ground_struct(model, find_ground(model), ground_module)
    x, y = (np.asarray(v, dtype=np.float32) for v in np.broadcast_arrays(x, y))
    out = wp.zeros(len(x), dtype=wp.vec3, device="cpu")
    inputs = [ground, wp.array(x, device="cpu"), wp.array(y, device="cpu"), out]
    wp.launch(surface_kernel, len(x), inputs=inputs, device="cpu")
    return out.numpy()

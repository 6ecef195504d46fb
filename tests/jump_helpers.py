"""Hand-made robots and episodes, and ways to bring an environment's worlds into a chosen state, for its tests."""

import dataclasses

import numpy as np
import torch
import warp as wp

from jumper_warp.env import JumpEnv
from jumper_warp.tasks import make_task
from jumper_warp.tasks.task import ResetCfg
from kernels.task import JumpTask, RobotView, vec12

DEG = np.pi / 180.0
DEFAULT_ANGLE = np.tile([0.0, 45.0 * DEG, 45.0 * DEG], 4)
SCHEMES = ("standing", "default", "in_flight", "touchdown", "landed")


class Table:
    """Functions of (view, task, p), compiled into one kernel as a task's are, to be called one at a time."""

    def __init__(self, module, names: str, returns: type):
        """names: of the module's functions, separated by spaces; returns: float or bool."""
        self._names = names.split()
        self._returns = returns
        funcs = [getattr(module, name) for name in self._names]
        count = len(funcs)

        @wp.kernel(module="unique", enable_backward=False)
        def table_kernel(
            views: wp.array(dtype=RobotView),
            tasks: wp.array(dtype=JumpTask),
            p: wp.vec4,
            out: wp.array(dtype=wp.bool if returns is bool else float),
        ):
            for i in range(wp.static(count)):
                out[i] = wp.static(funcs[i])(views[0], tasks[0], p)

        self._kernel = table_kernel

    def __call__(self, name: str, view: RobotView, task: JumpTask, *p: float) -> float | bool:
        """Return the value of one function."""
        out = wp.zeros(len(self._names), dtype=wp.bool if self._returns is bool else float, device="cpu")
        inputs = [wp.array([view], dtype=RobotView, device="cpu"), wp.array([task], dtype=JumpTask, device="cpu")]
        wp.launch(self._kernel, 1, [*inputs, wp.vec4(*p, *([0.0] * (4 - len(p))))], [out], device="cpu")
        return self._returns(out.numpy()[self._names.index(name)])


def make_view(**fields) -> RobotView:
    """Return a robot at rest in the default pose, 0.4 m high; vectors of 12 may be any sequence."""
    view = RobotView()
    view.pos, view.quat, view.gravity = wp.vec3(0.0, 0.0, 0.4), wp.quat_identity(), wp.vec3(0.0, 0.0, -1.0)
    view.angle = view.default_angle = vec12(*DEFAULT_ANGLE)
    for name, value in fields.items():
        kind = type(getattr(view, name))
        setattr(view, name, kind(*value) if np.ndim(value) else value)
    return view


def make_episode(**fields) -> JumpTask:
    """Return an episode in stance whose jump is commanded from the beginning."""
    task = JumpTask()
    for name, value in fields.items():
        setattr(task, name, wp.vec3(*value) if np.ndim(value) else value)
    return task


def tilted_by(angle: float, axis=(1.0, 0.0, 0.0)) -> dict:
    """Return orientation and gravity of a robot tilted by an angle [rad] about a horizontal axis."""
    quat = wp.quat_from_axis_angle(wp.vec3(*axis), float(angle))
    return {"quat": tuple(quat), "gravity": tuple(wp.quat_rotate_inv(quat, wp.vec3(0.0, 0.0, -1.0)))}


def only(scheme: str, **ranges) -> ResetCfg:
    """Return resets that all follow one scheme."""
    shares = dict.fromkeys(SCHEMES[:4], 0.0) | ({} if scheme == "landed" else {scheme: 1.0})
    return ResetCfg(**shares, **ranges)


def make_env(num_envs: int, *, seed: int = 0, reset: ResetCfg | None = None, task=None, **arguments) -> JumpEnv:
    """Return the vertical jump's environment on the CPU, begun; nominal and without noise unless asked for."""
    task = make_task("vertical-jump") if task is None else task
    task = task if reset is None else dataclasses.replace(task, reset=reset)
    env = JumpEnv(task, num_envs, seed=seed, device="cpu", **({"randomize": False, "noise": False} | arguments))
    env.reset()
    return env


def edit_episodes(env: JumpEnv, worlds=slice(None), **fields) -> None:
    """Overwrite fields of worlds' episodes."""
    records = env.tasks.numpy().copy()
    for name, value in fields.items():
        records[name][worlds] = value
    env.tasks.assign(wp.array(records, dtype=JumpTask, device="cpu"))


def edit_coordinates(env: JumpEnv, world: int, *, q: dict | None = None, qd: dict | None = None) -> None:
    """Overwrite entries, by index, of a world's joint coordinates and rates."""
    for array, width, values in ((env.sim.state.joint_q, 43, q), (env.sim.state.joint_qd, 38, qd)):
        rows = array.numpy().reshape(-1, width).copy()
        for index, value in (values or {}).items():
            rows[world, index] = value
        array.assign(rows.ravel())


def random_actions(num_envs: int, steps: int, seed: int = 0) -> torch.Tensor:
    """Return uniform actions, (steps, num_envs, 12)."""
    return 2.0 * torch.rand((steps, num_envs, 12), generator=torch.Generator().manual_seed(seed)) - 1.0


def rule_names(env: JumpEnv) -> list[str]:
    """Return the rule that ended each world's episode in the last step, "" where none did."""
    names = [rule.name for rule in env.task.rules]
    return [names[i] if i >= 0 else "" for i in env.task_arrays()["rule"]]

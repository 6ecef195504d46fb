"""Hand-made robots and episodes, and ways to bring an environment's worlds into a chosen state, for its tests."""

import dataclasses

import numpy as np
import torch
import warp as wp

from jumper_warp.envs.env import JumpEnv
from jumper_warp.registry import make_task
from jumper_warp.tasks.cfg import NoiseCfg, ResetCfg
from kernels.jump.observe import Observations
from kernels.jump.task import JumpTask, RobotView, ViewArrays, vec12
from kernels.terrain.ground import Ground

DEG = np.pi / 180.0
DEFAULT_ANGLE = np.tile([0.0, 45.0 * DEG, 45.0 * DEG], 4)
MOTOR_SLOTS = np.array([5 * leg + joint for leg in range(4) for joint in (0, 1, 3)])
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
            out: wp.array2d(dtype=wp.bool if returns is bool else float),
        ):
            j = wp.tid()
            for i in range(wp.static(count)):
                out[j, i] = wp.static(funcs[i])(views[j], tasks[j], p)

        self._kernel = table_kernel

    def __call__(self, name: str, view: RobotView, task: JumpTask, *p: float) -> float | bool:
        """Return the value of one function."""
        return self._returns(self.all(name, [view], [task], *p)[0])

    def all(self, name: str, views: list, tasks: list, *p: float) -> np.ndarray:
        """Return the values of one function, one a robot and its episode."""
        shape = (len(views), len(self._names))
        out = wp.zeros(shape, dtype=wp.bool if self._returns is bool else float, device="cpu")
        inputs = [wp.array(views, dtype=RobotView, device="cpu"), wp.array(tasks, dtype=JumpTask, device="cpu")]
        wp.launch(self._kernel, len(views), [*inputs, wp.vec4(*p, *([0.0] * (4 - len(p))))], [out], device="cpu")
        return out.numpy()[:, self._names.index(name)]


def make_view(**fields) -> RobotView:
    """Return a robot at rest in the default pose, 0.4 m high; vectors of 12 may be any sequence."""
    view = RobotView()
    view.pos, view.quat, view.gravity = wp.vec3(0.0, 0.0, 0.4), wp.quat_identity(), wp.vec3(0.0, 0.0, -1.0)
    view.angle = view.default_angle = vec12(*DEFAULT_ANGLE)
    for name, value in fields.items():
        kind = type(getattr(view, name))
        setattr(view, name, kind(*value) if np.ndim(value) else value)
    view.height = fields.get("height", view.pos[2])
    return view


def make_episode(**fields) -> JumpTask:
    """Return an episode in stance whose jump is commanded from the beginning."""
    task = JumpTask()
    for name, value in fields.items():
        setattr(task, name, wp.vec3(*value) if np.ndim(value) else value)
    return task


class Robots:
    """Robots that stand at rest in the default pose, to be changed by the tests, and what is observed of them."""

    def __init__(self, kernel: wp.Kernel, n: int = 1):
        """kernel: of `make_observe_kernel`."""
        self.kernel, self.n = kernel, n
        self.q, self.qd = np.zeros((n, 43)), np.zeros((n, 38))
        self.q[:, 2], self.q[:, 6], self.q[:, 7 + MOTOR_SLOTS] = 0.35, 1.0, DEFAULT_ANGLE
        self.com, self.action, self.offset = np.zeros(3), np.zeros((12, n)), np.zeros((12, n))
        self.force, self.heights = np.zeros((4, n, 3)), np.zeros((1, 1))
        self.tasks = [make_episode(goal=(0.0, 0.0, 0.8), command_step=5)] * n
        self.random = np.arange(1, n + 1, dtype=np.uint32) * np.uint32(7919)

    def observe(self, noise: bool = False) -> np.ndarray:
        """Return the actor's observations, (n, 48); draws go on from call to call."""
        return self.both(noise)[0]

    def both(self, noise: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Return the actor's observations, (n, 48), and the critic's, (n, 65); its last two columns were 7 before."""

        def array(value, dtype=float):
            return wp.array(np.asarray(value), dtype=dtype, device="cpu")

        views, n = ViewArrays(), self.n
        views.joint_q, views.joint_qd = array(self.q.ravel()), array(self.qd.ravel())
        views.body_com = array(np.tile(self.com, (21 * n, 1)), wp.vec3)
        views.paw_force = array(self.force, wp.vec3)
        for name in ("torque", "old_action", "target", "safe_target", "old_rate"):
            setattr(views, name, wp.zeros((12, n), dtype=float, device="cpu"))
        views.action = array(self.action)
        views.old_lin_vel = wp.zeros(n, dtype=wp.vec3, device="cpu")
        views.default_angle, views.step_dt = array(DEFAULT_ANGLE), 1.0 / 60.0
        out, none = Observations(), wp.zeros(n, dtype=float, device="cpu")
        out.actor = wp.zeros((n, 48), dtype=float, device="cpu")
        out.critic = wp.full((n, 65), 7.0, dtype=float, device="cpu")
        random = array(self.random, wp.uint32)
        tasks = wp.array(self.tasks, dtype=JumpTask, device="cpu")
        sensors = NoiseCfg().sensor_noise(noise)
        ground = Ground()
        ground.heights = wp.array(self.heights, dtype=float, device="cpu")
        ground.rows, ground.cols = self.heights.shape if self.heights.size > 1 else (0, 0)
        ground.half_x = ground.half_y = 2.0
        inputs = [views, ground, tasks, array(self.offset), sensors, none, 1, random]
        wp.launch(self.kernel, n, inputs, [out], device="cpu")
        self.random = random.numpy()
        return out.actor.numpy().astype(float), out.critic.numpy().astype(float)


def tilted_by(angle: float, axis=(1.0, 0.0, 0.0)) -> dict:
    """Return orientation and gravity of a robot tilted by an angle [rad] about a horizontal axis."""
    quat = wp.quat_from_axis_angle(wp.vec3(*axis), float(angle))
    return {"quat": tuple(quat), "gravity": tuple(wp.quat_rotate_inv(quat, wp.vec3(0.0, 0.0, -1.0)))}


def only(scheme: str, reset: ResetCfg | None = None, **ranges) -> ResetCfg:
    """Return resets that all follow one scheme, otherwise as `reset`."""
    shares = dict.fromkeys(SCHEMES[:4], 0.0) | ({} if scheme == "landed" else {scheme: 1.0})
    return dataclasses.replace(ResetCfg() if reset is None else reset, **shares, **ranges)


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

"""Robots and episodes with chosen states for tests of jump tasks, and functions that edit worlds of an environment."""

import dataclasses
import inspect
import math

import numpy as np
import torch
import warp as wp

from columns import MOTOR_COORDS, Z
from jumper_warp.envs.env import Env
from jumper_warp.envs.skill import TaskRuntime
from jumper_warp.kernels.jump.reset import JumpLevel, JumpSettings
from jumper_warp.kernels.jump.state import FLIGHT, LANDED, STANCE, JumpState
from jumper_warp.kernels.mdp.parameters import RobotParameters
from jumper_warp.kernels.mdp.view import RobotView, vec12
from jumper_warp.kernels.terrain.ground import Ground
from jumper_warp.registry import make_task
from jumper_warp.tasks.cfg import ObservationsCfg, TaskCfg
from jumper_warp.tasks.jump.cfg import Level, ResetCfg, StartProbability
from jumper_warp.tasks.jump.observations import EPISODE
from jumper_warp.tasks.observations import exact
from mdp_helpers import DEFAULT_ANGLE, STEP_DT, SUBSTEPS, array, new_worlds, observe, standing_robots

DEG = np.pi / 180.0
PHASES = (int(STANCE), int(FLIGHT), int(LANDED))
START_MODES = ("standing", "default", "in_flight", "touchdown", "after_landing", "pushing")
OF_WORLD = ("level", "streak")  # Fields of a world that last over episodes


class Table:
    """Functions of (robot, state, ...), compiled into one kernel like the terms of a task, and called by name."""

    def __init__(self, funcs, returns: type, state=JumpState):
        """funcs: functions of terms; returns: float or bool; state: struct of the task's state."""
        funcs, self._state = list(funcs), state
        self._params = {func.func.__name__: list(inspect.signature(func.func).parameters)[2:] for func in funcs}
        self._returns = returns
        counts = [len(params) for params in self._params.values()]

        @wp.kernel(module="unique", enable_backward=False)
        def table_kernel(
            views: wp.array(dtype=RobotView),
            tasks: wp.array(dtype=state),
            p: wp.array(dtype=float),
            out: wp.array2d(dtype=wp.bool if returns is bool else float),
        ):
            j = wp.tid()
            for i in range(wp.static(len(funcs))):
                if wp.static(counts[i] == 0):
                    out[j, i] = wp.static(funcs[i])(views[j], tasks[j])
                else:
                    out[j, i] = wp.static(funcs[i])(views[j], tasks[j], *p[0 : wp.static(counts[i])])

        self._kernel = table_kernel

    def __call__(self, name: str, robot: RobotView, task: JumpState, **numbers: float) -> float | bool:
        """Return the value of one function."""
        return self._returns(self.all(name, [robot], [task], **numbers)[0])

    def all(self, name: str, views: list, tasks: list, **numbers: float) -> np.ndarray:
        """Return the values of one function, one per robot and episode; numbers: all its parameters by name."""
        params = self._params[name]
        assert numbers.keys() == set(params), f"{name} has {params}, got {list(numbers)}"
        most = max(map(len, self._params.values()))
        p = array([numbers[key] for key in params] + [1.0] * (most - len(params)))
        shape = (len(views), len(self._params))
        out = wp.zeros(shape, dtype=wp.bool if self._returns is bool else float, device="cpu")
        inputs = [wp.array(views, dtype=RobotView, device="cpu"), wp.array(tasks, dtype=self._state, device="cpu")]
        wp.launch(self._kernel, len(views), [*inputs, p], [out], device="cpu")
        return out.numpy()[:, list(self._params).index(name)]

    def check(self, name: str, numbers: dict, rows: list, phases=None) -> None:
        """Assert the values of one function in a jump; rows: (value, fields of the robot, fields of the episode).

        phases: those in which it pays or holds; each row is repeated in the others, where its value must be 0.
        """
        if phases is not None:
            rows = [(value * (phase in phases), robot, episode | {"phase": phase})
                    for value, robot, episode in rows for phase in PHASES]  # fmt: skip
        views = [make_view(**robot) for _, robot, _ in rows]
        values = self.all(name, views, [make_episode(**episode) for _, _, episode in rows], **numbers)
        expected = [float(row[0]) for row in rows]
        for row, value, wanted in zip(rows, values.tolist(), expected, strict=True):
            assert math.isclose(value, wanted, rel_tol=1e-4, abs_tol=1e-6), f"{name}: got {value}, expected {row}"


def functions(module, names: str) -> list[wp.Function]:
    """Return functions of a module; names: separated by spaces."""
    return [getattr(module, name) for name in names.split()]


def make_view(**fields) -> RobotView:
    """Return a robot at rest in the default pose, 0.4 m high; vectors of 12 may be any sequence."""
    view = RobotView()
    view.pos, view.quat, view.projected_gravity = wp.vec3(0.0, 0.0, 0.4), wp.quat_identity(), wp.vec3(0.0, 0.0, -1.0)
    view.angle = view.default_angle = vec12(*DEFAULT_ANGLE)
    view.gravity_magnitude = 9.81
    for name, value in fields.items():
        kind = type(getattr(view, name))
        setattr(view, name, kind(*value) if np.ndim(value) else value)
    view.height = fields.get("height", view.pos[2])
    return view


def make_episode(**fields) -> JumpState:
    """Return an episode in stance whose jump is commanded from the beginning."""
    task = JumpState()
    for name, value in fields.items():
        setattr(task, name, wp.vec3(*value) if np.ndim(value) else value)
    return task


def without_draws(task: TaskCfg) -> TaskCfg:
    """Return a jump without history, whose critic observes no randomised parameters: 48 actor columns and 15 more."""
    actor = tuple(term.replace(history=1) for term in task.observations.actor)
    return dataclasses.replace(task, observations=ObservationsCfg(actor=actor, critic=(*exact(actor), *EPISODE)))


class Robots:
    """Robots at rest in the default pose, whose state tests may change, and their observations."""

    def __init__(self, task: TaskCfg, n: int = 1):
        """task: a jump task; observations of randomised parameters are left out; n: number of robots."""
        task = without_draws(task)
        self.skill, self.n = TaskRuntime(task, 0, n, STEP_DT, SUBSTEPS, "cpu"), n
        self.numbers = {True: array(task.params.values), False: array(task.without_noise().params.values)}
        self.q, self.qd = np.zeros((n, 43)), np.zeros((n, 38))
        self.q[:, Z], self.q[:, 6], self.q[:, MOTOR_COORDS] = 0.35, 1.0, DEFAULT_ANGLE
        self.com, self.action, self.offset = np.zeros(3), np.zeros((12, n)), np.zeros((12, n))
        self.force, self.heights = np.zeros((4, n, 3)), np.zeros((1, 1))
        self.tasks = [make_episode(goal=(0.0, 0.0, 0.8), command_step=5)] * n
        self.episodes = new_worlds(n, seed=7919)

    def observe(self, noise: bool = False) -> np.ndarray:
        """Return the actor's observations, (n, 48); each call has new noise."""
        return self.both(noise)[0]

    def both(self, noise: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Return the actor's observations, (n, 48), and the critic's, (n, 63)."""
        robot, n, skill = standing_robots(self.n), self.n, self.skill
        robot.joint_q, robot.joint_qd = array(self.q.ravel()), array(self.qd.ravel())
        robot.body_com = array(np.tile(self.com, (21 * n, 1)), wp.vec3)
        robot.paw_force = array(self.force, wp.vec3)
        robot.action, robot.joint_offset = array(self.action), array(self.offset)
        tasks = wp.array(self.tasks, dtype=JumpState, device="cpu")
        ground = Ground()
        ground.heights = array(self.heights)
        ground.rows, ground.cols = self.heights.shape if self.heights.size > 1 else (0, 0)
        ground.half_x = ground.half_y = 2.0
        observe(skill, robot, RobotParameters(), ground, self.episodes, tasks, self.numbers[noise])
        self.episodes.step_count.assign(self.episodes.step_count.numpy() + 1)
        return skill.obs["actor"].double().numpy().copy(), skill.obs["critic"].double().numpy().copy()


def tilted_by(angle: float, axis=(1.0, 0.0, 0.0)) -> dict:
    """Return orientation and gravity of a robot tilted by an angle [rad] about a horizontal axis."""
    quat = wp.quat_from_axis_angle(wp.vec3(*axis), float(angle))
    return {"quat": tuple(quat), "projected_gravity": tuple(wp.quat_rotate_inv(quat, wp.vec3(0.0, 0.0, -1.0)))}


def only(start_mode: str, reset: ResetCfg | None = None, **ranges) -> ResetCfg:
    """Return the reset settings `reset` with probability 1 of one start mode; ranges: other changed fields."""
    probability = StartProbability(**{start_mode: 1.0})
    return dataclasses.replace(ResetCfg() if reset is None else reset, start_probability=probability, **ranges)


def resetting(task: TaskCfg, reset: ResetCfg) -> TaskCfg:
    """Return a jump task with other reset settings."""
    return dataclasses.replace(task, reset=dataclasses.replace(task.reset, settings=reset))


def make_env(num_envs: int, *, seed: int = 0, reset: ResetCfg | None = None, task=None, **arguments) -> Env:
    """Return a reset environment on the CPU, by default of the vertical jump, nominal and without noise."""
    task = make_task("vertical-jump") if task is None else task
    task = task if reset is None else resetting(task, reset)
    env = Env(task, num_envs, seed=seed, device="cpu", **({"randomize": False, "noise": False} | arguments))
    env.reset()
    return env


def begin_by(env: Env, reset: ResetCfg) -> None:
    """Change the reset settings of an environment, also in captured steps."""
    env.skills[0].settings.assign(wp.array([reset.values(env.step_dt)], dtype=JumpSettings, device="cpu"))


def set_levels(env: Env, *levels: Level) -> None:
    """Replace the levels of an environment, by as many or by one for all."""
    levels = levels if len(levels) > 1 else levels * len(env.task.levels)
    values = [level.values() for level in levels]
    env.skills[0].levels.assign(wp.array(values, dtype=JumpLevel, device="cpu"))


def resets_of(env: Env) -> ResetCfg:
    """Return the reset settings that an environment was constructed with."""
    return env.skills[0].task.reset.settings


def edit_episodes(env: Env, worlds=slice(None), **fields) -> None:
    """Overwrite fields of worlds' episodes, or their level and streak."""
    states = env.skills[0].states
    records = states.numpy().copy()
    for name, value in fields.items():
        if name in OF_WORLD:
            array_of_worlds = getattr(env.episodes, name)
            values = array_of_worlds.numpy().copy()
            values[worlds] = value
            array_of_worlds.assign(values)
        else:
            records[name][worlds] = value
    states.assign(wp.array(records, dtype=JumpState, device="cpu"))


def episodes_of(env: Env) -> dict[str, np.ndarray]:
    """Return copies of all fields of worlds' episodes, and their level and streak."""
    records = env.skills[0].states.numpy()
    fields = {name: records[name].copy() for name in records.dtype.names}
    return fields | {name: getattr(env.episodes, name).numpy().copy() for name in OF_WORLD}


def edit_coordinates(env: Env, world: int, *, q: dict | None = None, qd: dict | None = None) -> None:
    """Overwrite entries, by index, of a world's joint coordinates and rates."""
    for coordinates, width, values in ((env.sim.state.joint_q, 43, q), (env.sim.state.joint_qd, 38, qd)):
        rows = coordinates.numpy().reshape(-1, width).copy()
        for index, value in (values or {}).items():
            rows[world, index] = value
        coordinates.assign(rows.ravel())


def random_actions(num_envs: int, steps: int, seed: int = 0) -> torch.Tensor:
    """Return uniform actions, (steps, num_envs, 12)."""
    return 2.0 * torch.rand((steps, num_envs, 12), generator=torch.Generator().manual_seed(seed)) - 1.0


def ending_names(env: Env) -> list[str]:
    """Return the termination that ended each world's episode in the last step, "" where none did."""
    names = [term.name for term in env.task.terminations]
    return [names[i] if i >= 0 else "" for i in env.task_arrays()["termination"]]

"""The environment: a task on a simulation, in one sequence of launches per policy step."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch
import warp as wp

from jumper_warp.envs.randomization import NUM_DRAWN, RandomizationCfg, Randomizer, no_motion
from jumper_warp.envs.state import load_state, save_state
from jumper_warp.robot.description import load_description
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.robot.motors import filter_params
from jumper_warp.sim.dynamics import JumperDynamics
from jumper_warp.sim.simulation import Simulation, SolverName
from jumper_warp.sim.solver import SolverJumper
from jumper_warp.tasks.cfg import GroundCfg, TaskCfg
from kernels.jump.evaluation import begin_evaluation_kernel, next_jump_kernel
from kernels.jump.observe import NUM_EPISODE_COLUMNS, Observations, make_observe_kernel
from kernels.jump.reset import clear_world_kernel, reset_kernel
from kernels.jump.task import JumpTask, ViewArrays
from kernels.kinematics.inverse import LegLimits
from kernels.mdp.control import ActionScales, action_kernel, push_kernel
from kernels.mdp.episode import EpisodeArrays, EpisodeSettings, make_episode_kernel

CONTACT_TOLERANCE = 1.0e-4
"""[m/s] Of the contact iteration: a fifth fewer sweeps than the solver's default."""
COUNTING_SCHEMES = 2
"""Standing and default starts count for the curriculum and the success rate."""


class JumpEnv:
    """Many robots on one task. Torch sees Warp's memory; nothing in `step` waits for the device.

    Attributes, tensors on the device, rewritten in place by `reset` and `step`:
        obs: (num_envs, num_obs), of the next step; an ended episode has begun anew.
        final_obs: the same before that new beginning.
        critic_obs, final_critic_obs: the same without noise, with the episode's state and the drawn parameters.
        reward, done, timeout: (num_envs,); done 1 where an episode ended, timeout 1 where it did without failure.
    """

    def __init__(
        self,
        task: TaskCfg,
        num_envs: int,
        *,
        seed: int = 0,
        device: str | None = None,
        solver: SolverName = "jumper",
        randomize: bool = True,
        noise: bool = True,
        auto_reset: bool = True,
        visuals: bool = False,
        ground: Any = "plane",
        block: BlockCfg | None = None,
    ):
        """Build everything; call `reset` before the first step.

        ground, block: as in `Simulation`. By default those of the task if randomised on SolverJumper, else a plane.
        Raises ValueError for less than one environment, or as `Simulation`.
        """
        self.task, self.num_envs, self.seed = task, num_envs, seed
        level = not randomize or solver != "jumper" or ground != "plane" or block is not None
        self.drawn_ground = GroundCfg() if level else task.ground
        if self.drawn_ground.drawn:
            block = BlockCfg((0.0, 0.0))
        self.sim = Simulation(
            num_envs, solver=solver, motors=task.motors, visuals=visuals, device=device, ground=ground, block=block,
            tolerance=CONTACT_TOLERANCE,
            friction=0.85 if task.randomization.dynamic_friction else 0.9,
        )  # fmt: skip
        self.wp_device = self.sim.device
        self.device = torch.device(wp.device_to_torch(self.wp_device))
        if self.wp_device.is_cuda:
            torch.cuda.set_stream(wp.stream_to_torch(wp.get_stream(self.wp_device)))
        self.physics_dt = self.sim.dt
        self.step_dt = self.sim.dt * self.sim.substeps
        self.auto_reset = auto_reset
        self.noise = task.noise.sensor_noise(noise)
        self._graphs: dict[bool, Any] = {}
        if self.drawn_ground.drawn:
            self.sim.solver.dynamics.robot.ground.blocks.zero_()  # until `reset` draws them
        self._allocate()
        self._prepare_kernels()
        jumper = isinstance(self.sim.solver, SolverJumper)
        self._dynamics = self.sim.solver.dynamics if jumper else JumperDynamics(self.sim.model)
        self.static_friction_ratio = self._dynamics.static_friction_ratio
        cfg = task.randomization if randomize else RandomizationCfg.off()
        self.randomizer = Randomizer(self.sim.model, self.sim.motors, cfg, seed)
        self.randomizer.apply(self)
        drawn = torch.from_numpy(self.randomizer.drawn(self).T).to(self.device)
        for critic_obs in (self.critic_obs, self.final_critic_obs):
            critic_obs[:, -NUM_DRAWN:] = drawn

    # ------------------------------------------------------------------ set-up

    def _zeros(self, shape: int | tuple[int, ...], dtype: Any = float) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.wp_device)

    def _allocate(self) -> None:
        n, sim, task = self.num_envs, self.sim, self.task
        self.num_obs = len(task.observation_names)
        self.num_actions = 12
        rest = no_motion(self.wp_device, n)
        self.push, self.delay, self.joint_offset = rest["push"], rest["delay"], rest["joint_offset"]
        self._previous_target = self._zeros((12, n))
        self._random = wp.array(
            np.random.default_rng(self.seed + 7919).integers(1, 2**31, n, dtype=np.uint32), device=self.wp_device
        )
        self._action = self._zeros((n, 12))
        self.num_critic_obs = self.num_obs + int(NUM_EPISODE_COLUMNS) + NUM_DRAWN
        self._obs, self._final_obs = Observations(), Observations()
        for observations in (self._obs, self._final_obs):
            observations.actor = self._zeros((n, self.num_obs))
            observations.critic = self._zeros((n, self.num_critic_obs))
        self.tasks = wp.zeros(n, dtype=JumpTask, device=self.wp_device)
        self._invalid = sim.solver.invalid if isinstance(sim.solver, SolverJumper) else self._zeros(n, int)
        self._impulse = (
            sim.solver.dynamics.work.impulse if isinstance(sim.solver, SolverJumper) else self._zeros((4, n), wp.vec3)
        )
        out = EpisodeArrays()
        for name in ("reward", "done", "timeout", "error_sum"):
            setattr(out, name, self._zeros(n))
        for name in ("rule", "counted", "succeeded"):
            setattr(out, name, self._zeros(n, int))
        out.term_value, out.term_sum = self._zeros((len(task.terms), n)), self._zeros((len(task.terms), n))
        out.rule_count = self._zeros((len(task.rules), n), int)
        self._out = out
        self._views = self._view_arrays()
        self._ones = wp.full(n, 1.0, dtype=float, device=self.wp_device)
        self.action = wp.to_torch(self._action)
        self.obs, self.final_obs = wp.to_torch(self._obs.actor), wp.to_torch(self._final_obs.actor)
        self.critic_obs = wp.to_torch(self._obs.critic)
        self.final_critic_obs = wp.to_torch(self._final_obs.critic)
        self.reward, self.done = wp.to_torch(out.reward), wp.to_torch(out.done)
        self.timeout = wp.to_torch(out.timeout)

    def _view_arrays(self) -> Any:
        n, sim = self.num_envs, self.sim
        views = ViewArrays()
        views.joint_q, views.joint_qd = sim.state.joint_q, sim.state.joint_qd
        views.body_com, views.paw_force, views.torque = sim.model.body_com, sim.paw_force, sim.torque
        for name in ("action", "old_action", "target", "safe_target", "old_rate"):
            setattr(views, name, self._zeros((12, n)))
        views.old_lin_vel = self._zeros(n, wp.vec3)
        pose = load_description().pose("default")
        views.default_angle = wp.array(pose, dtype=float, device=self.wp_device)
        views.step_dt = self.step_dt
        return views

    def _prepare_kernels(self) -> None:
        task, device = self.task, self.wp_device
        self._episode_kernel = make_episode_kernel(task.terms, task.rules, task.error)
        self._observe_kernel = make_observe_kernel(task.observe)
        self._scales = ActionScales()
        self._scales.lateral, self._scales.transversal = (math.radians(s) for s in task.action_scale)
        self._filter = filter_params(task.command_filter)
        settings = EpisodeSettings()
        settings.step_dt, settings.contact_force = self.step_dt, task.contact_force
        settings.takeoff_speed, settings.games, settings.near = task.takeoff_speed, task.games, task.near
        settings.num_levels, settings.counting_schemes = len(task.levels), COUNTING_SCHEMES
        self._settings = settings

        def params(rows: tuple) -> wp.array:
            padded = [(*row.params, *([0.0] * (4 - len(row.params)))) for row in rows]
            return wp.array(padded, dtype=wp.vec4, device=device)

        self.weights = wp.array([term.weight for term in task.terms], dtype=float, device=device)
        self._term_params, self._rule_params = params(task.terms), params(task.rules)
        self._ranges, self._grounds = task.reset.ranges(self.step_dt), self.drawn_ground.ranges()
        self._goal_lower = wp.array([level.goal_lower for level in task.levels], dtype=wp.vec3, device=device)
        self._goal_upper = wp.array([level.goal_upper for level in task.levels], dtype=wp.vec3, device=device)
        self._base_height = wp.array([level.base_height for level in task.levels], dtype=wp.vec2, device=device)
        self._limits = _leg_limits(task)

    def notify(self, flags: int) -> None:
        """Let the solver read changed parameters of the model."""
        self.sim.solver.notify_model_changed(flags)
        self._dynamics.pack_friction()

    # ------------------------------------------------------------------ stepping

    def reset(self) -> None:
        """Begin a new episode in every world."""
        self._begin(self._ones)
        self._observe(self._final_obs, everywhere=1)
        self._copy_observations()

    def step(self, action: torch.Tensor) -> None:
        """Advance one policy step; action: (num_envs, 12), clamped to -1..1."""
        self.action.copy_(action)
        if self.wp_device.is_cuda and torch.cuda.is_current_stream_capturing():
            self._launch_step()
            return
        if self.auto_reset not in self._graphs:
            self._launch_step()  # loads the modules; counts as this step
            with wp.ScopedCapture(device=self.wp_device) as capture:
                self._launch_step()
            self._graphs[self.auto_reset] = capture.graph
            return
        wp.capture_launch(self._graphs[self.auto_reset])

    def _launch_step(self) -> None:
        n, sim, views = self.num_envs, self.sim, self._views
        self._launch(
            action_kernel,
            (n, 4),
            [self._action, self._scales, self._filter, views, self.joint_offset],
            [self._previous_target],
        )
        self._launch(push_kernel, n, [self.tasks, self.push], [sim.state.body_f])
        sim.physics(sim.substeps, views.safe_target, self._previous_target, self.delay, bodies=False)
        self._launch(
            self._episode_kernel,
            n,
            [views, self._dynamics.robot.geometry, self._dynamics.robot.ground, self._invalid, self._settings,
             self.weights, self._term_params, self._rule_params, self.tasks, self._out],
            [],
        )  # fmt: skip
        self._observe(self._final_obs, everywhere=1)
        self._copy_observations()
        if self.auto_reset:
            self._begin(self._out.done)
            self._observe(self._obs, everywhere=0)

    def _begin(self, done: wp.array) -> None:
        """Begin new episodes where `done` is not 0."""
        n, sim, dyn = self.num_envs, self.sim, self._dynamics
        self._launch(
            reset_kernel,
            n,
            [done, dyn.robot.geometry, dyn.robot.ground, self._limits, self._ranges, self._grounds,
             self._goal_lower, self._goal_upper, self._base_height, sim.model.joint_q, self._random, self.tasks,
             sim.state.joint_q, sim.state.joint_qd],
            [],
        )  # fmt: skip
        self._clear(done)

    def _clear(self, done: wp.array) -> None:
        sim, views = self.sim, self._views
        self._launch(
            clear_world_kernel,
            self.num_envs,
            [done, sim.state.joint_q],
            [self._impulse, sim.paw_force, self._invalid, sim.torque, views.action, views.old_action,
             views.safe_target, views.old_rate, views.old_lin_vel, sim.state.joint_qd],
        )  # fmt: skip
        if not isinstance(sim.solver, SolverJumper):
            self._dynamics.full_state(sim.state.joint_q, sim.state.joint_qd, sim.state.body_q, sim.state.body_qd)

    def _copy_observations(self) -> None:
        wp.copy(self._obs.actor, self._final_obs.actor)
        wp.copy(self._obs.critic, self._final_obs.critic)

    def _observe(self, out: Any, everywhere: int) -> None:
        self._launch(
            self._observe_kernel,
            self.num_envs,
            [self._views, self._dynamics.robot.ground, self.tasks, self.joint_offset, self.noise, self._out.done,
             everywhere, self._random],
            [out],
        )  # fmt: skip

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list, outputs: list) -> None:
        # small blocks spread a few thousand heavy threads over all multiprocessors
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.wp_device, block_dim=32)

    # ------------------------------------------------------------------ looking at it

    def evaluation_reset(
        self,
        goals: torch.Tensor | np.ndarray,
        command_delay: np.ndarray | float = 0.5,
        headings: np.ndarray | float = 0.0,
    ) -> None:
        """Stand every world in the default pose with a goal of its own, shape (num_envs, 3), and end no episode.

        goals [m]: relative to start and heading, as in `JumpTask.goal`.
        command_delay [s], headings [rad]: until the jump is commanded, and of the robot; (num_envs,) or one for all.
        """
        self.auto_reset = False
        if self.drawn_ground.drawn:
            self._dynamics.robot.ground.blocks.zero_()
        headings = self._each(headings, np.float32)
        command_step = self._each(np.round(np.asarray(command_delay) / self.step_dt), np.int32)
        self._launch(
            begin_evaluation_kernel,
            self.num_envs,
            [self._vectors(goals), headings, command_step, self._dynamics.robot.ground, self.sim.model.joint_q],
            [self.tasks, self.sim.state.joint_q, self.sim.state.joint_qd],
        )  # fmt: skip
        self._clear(self._ones)
        self._out.done.zero_()
        self._observe(self._final_obs, everywhere=1)
        self._copy_observations()

    def next_jump(self, goals: torch.Tensor | np.ndarray, worlds: np.ndarray) -> None:
        """Command another jump in some worlds, those of them that have landed; the policy sees it after the next step.

        goals [m]: (num_envs, 3), relative to base and yaw as they are. worlds: (num_envs,) bool.
        """
        chosen = wp.array(np.asarray(worlds).astype(np.int32), dtype=int, device=self.wp_device)
        inputs = [self._vectors(goals), chosen, self._dynamics.robot.ground, self.sim.state.joint_q]
        self._launch(next_jump_kernel, self.num_envs, inputs, [self.tasks])

    def _each(self, values: np.ndarray | float, dtype: type) -> wp.array:
        """Return values (num_envs,), or one for all, on the device."""
        return wp.array(np.broadcast_to(np.asarray(values, dtype=dtype), self.num_envs), device=self.wp_device)

    def _vectors(self, values: torch.Tensor | np.ndarray) -> wp.array:
        return wp.array(np.asarray(values, dtype=np.float32), dtype=wp.vec3, device=self.wp_device)

    def task_arrays(self) -> dict[str, np.ndarray]:
        """Return the state of every world's episode, one array of shape (num_envs, ...) a field (waits for the device).

        Besides the fields of `JumpTask`: base_pos [m], base_vel [m/s], base_quat (xyzw), done, rule.
        """
        records = self.tasks.numpy()
        arrays = {name: np.array(records[name]) for name in records.dtype.names}
        q, qd = self.sim.joint_q(), self.sim.joint_qd()
        arrays |= {"base_pos": q[:, :3].copy(), "base_quat": q[:, 3:7].copy(), "base_vel": qd[:, :3].copy()}
        return arrays | {"done": self._out.done.numpy().copy(), "rule": self._out.rule.numpy().copy()}

    def metrics(self) -> dict[str, float]:
        """Return means since the last call, and clear the counters (waits for the device)."""
        out, figures = self._out, {}
        ended = max(int(out.rule_count.numpy().sum()), 1)
        for term, total in zip(self.task.terms, out.term_sum.numpy().sum(axis=1), strict=True):
            figures[f"Episode_Reward/{term.name}"] = float(total) / ended
        for rule, count in zip(self.task.rules, out.rule_count.numpy().sum(axis=1), strict=True):
            figures[f"Episode_Termination/{rule.name}"] = float(count) / ended
        counted, succeeded = int(out.counted.numpy().sum()), int(out.succeeded.numpy().sum())
        figures["Metrics/success"] = succeeded / max(counted, 1)
        figures["Metrics/error_m"] = float(out.error_sum.numpy().sum()) / max(succeeded, 1)
        levels = np.bincount(self.tasks.numpy()["level"], minlength=len(self.task.levels) + 1)
        for level, count in enumerate(levels):
            figures[f"Curriculum/level_{level}"] = float(count) / self.num_envs
        for array in (out.term_sum, out.rule_count, out.counted, out.succeeded, out.error_sum):
            array.zero_()
        return figures

    def config(self) -> dict:
        """Return everything that defines the environment, as JSON can hold it."""
        return {
            "task": plain(self.task),
            "observation_names": list(self.task.observation_names),
            "num_envs": self.num_envs,
            "seed": self.seed,
            "physics_dt_s": self.physics_dt,
            "policy_dt_s": self.step_dt,
            "contact_tolerance_m_s": CONTACT_TOLERANCE,
            "solver": type(self.sim.solver).__name__,
            "quaternion_order": "xyzw",
        }

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return everything that the next step depends on, as `jumper_warp.envs.state.save_state`."""
        return save_state(self)

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from a saved state, in the same steps; raises ValueError as `jumper_warp.envs.state.load_state`."""
        load_state(self, state)


def _leg_limits(task: TaskCfg) -> Any:
    """Return the kernels' `LegLimits` of a task's command filter."""
    cfg, limits = task.command_filter, LegLimits()
    for name, pair in (("lateral", cfg.lateral), ("transversal", cfg.transversal), ("sum", cfg.sum)):
        setattr(limits, f"{name}_lower", math.radians(pair.lower))
        setattr(limits, f"{name}_upper", math.radians(pair.upper))
    return limits


def plain(value: Any) -> Any:
    """Return a configuration as JSON can hold it; functions become their names."""
    if dataclasses.is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, wp.Function):
        return value.key
    if isinstance(value, (tuple, list)):
        return [plain(v) for v in value]
    return value

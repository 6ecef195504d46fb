"""Reinforcement-learning environment: tasks on a simulation, in one sequence of kernel launches per policy step.

`Env` is the public interface, one class; its base class `Stages` launches the kernels. Sections of `Env`: construction;
episodes and steps; settings, commands and hand-overs; observed values and saved states.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from numbers import Integral
from typing import Any, NamedTuple

import newton
import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike

from jumper_warp.diff.snapshot import Snapshot, compact_columns
from jumper_warp.envs import arrays
from jumper_warp.envs.gradients import EnvGradients
from jumper_warp.envs.skill import TaskRuntime, kernels_of
from jumper_warp.envs.stages import STAGES, Stages, with_blocks
from jumper_warp.envs.state import load_state, save_state
from jumper_warp.kernels.mdp.env import Counters
from jumper_warp.kernels.mdp.reset import default_pose_kernel
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.robot.model import PHYSICS_DT
from jumper_warp.robot.motors import MOTOR_CONSTANTS
from jumper_warp.robot.overlay import RobotOverlay, robots_of
from jumper_warp.sim.dynamics import advance_kernel
from jumper_warp.sim.simulation import SUBSTEPS, Simulation, SlicedGraph, SolverName
from jumper_warp.tasks.cfg import OF_EPISODE, Handover, TaskCfg, checked_tasks
from jumper_warp.tasks.interface import interface
from jumper_warp.tasks.mirror import Mirror, mirror_image
from jumper_warp.tasks.overlay_ranges import moves_of, ranges_of, with_own_ranges
from jumper_warp.tasks.saving import handover_to_json, task_to_json
from jumper_warp.utils.checks import check_count, check_flags, check_seed
from jumper_warp.utils.dumps import NonFiniteValue
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import load_kernels, loading_kernels, records
from jumper_warp.utils.runtime import init_warp
from jumper_warp.utils.streams import PURPOSES, Purpose
from jumper_warp.utils.threads import WARP_LOCK, locked

Values = ArrayLike | torch.Tensor  # Numbers, lists, arrays or tensors
CONTACT_TOLERANCE = 1.0e-4
"""[m/s] Stopping tolerance of the contact iteration, looser than the solver's default, for a fifth fewer sweeps."""


class Step(NamedTuple):
    """Observations, reward and end flags of `Env.step`; tensors on the device that the next step overwrites."""

    obs: dict[str, torch.Tensor]
    """Observations (num_envs, columns) by group (`actor`, `critic`), after resets of ended episodes."""
    reward: torch.Tensor  # (num_envs,)
    terminated: torch.Tensor  # (num_envs,) bool, whether the episode ended with failure
    truncated: torch.Tensor  # (num_envs,) bool, whether it ended without failure (time limit or success)
    extras: dict[str, Any]  # `final_obs`: as `obs`, before resets; `time_outs`: `truncated` as float, (num_envs,)


class Env(Stages):
    """Vectorised environment with one robot per world, on one task or several. `step` never waits for the device.

    With several tasks each world has one at a time. Attributes are tensors on the device that `reset` and `step`
    overwrite; observations and reward terms are those of the first task:
        obs, critic_obs: (num_envs, columns), after resets of ended episodes.
        final_obs, final_critic_obs: (num_envs, columns), before resets.
        reward_terms: (num_envs,) by name of the reward: value times weight times policy step (1/60 s), or without the
        policy step if the term has `scale_by_dt=False`; their sum, before `reward_floor`, is the reward. Of worlds on
        that task.
        reward, done, timeout: (num_envs,); done 1 where an episode ended, timeout 1 where it ended without failure.
    `Stages` holds the arrays and launches the kernels. Python threads can have an environment each.
    """

    @locked
    def __init__(
        self,
        task: TaskCfg | Sequence[TaskCfg],
        num_envs: int,
        *,
        seed: int = 0,
        stream: Purpose = "training",
        device: str | torch.device | None = None,
        solver: SolverName = "jumper",
        randomize: bool = True,
        noise: bool = True,
        auto_reset: bool = True,
        visuals: bool = False,
        ground: str | newton.Heightfield | None = "plane",
        block: BlockCfg | None = None,
        skill: np.ndarray | int = 0,
        handovers: Sequence[Handover] = (),
        robot: RobotOverlay | Sequence[RobotOverlay] | None = None,
        threads: int | None = None,
        refine: int = 1,
    ):
        """Allocate simulation and arrays, and compile most kernels meanwhile; call `reset` before the first step.

        stream: purpose of all random numbers; numbers of two purposes differ for any seeds, also after `reset(seed)`.
        randomize, noise: enable domain randomisation, observation noise. auto_reset: reset ended episodes in `step`.
        ground, block: as in `Simulation`; by default the terrain of the first task that has one, else the tasks'
        sampled ground (SolverJumper with randomize), else a plane. skill: index of each world's first task, (num_envs,)
        or one for all. robot: a robot (`load_overlay`), around which robots are randomised
        (`jumper_warp.tasks.overlay_ranges`), or several, which worlds take in turn.
        threads: CPU threads, as in `Simulation`.
        refine: factor by which the physics step is shorter than in training.
        Raises InputError (a ValueError): see `checked_tasks` and `Simulation`, num_envs or refine no whole number of at
        least 1, a seed not in 0 to 2^31 - 1, or no such stream.
        """
        num_envs = check_count("num_envs", num_envs)
        refine = check_count("refine", refine)
        seed = check_seed(seed)
        check_flags(randomize=randomize, noise=noise, auto_reset=auto_reset)
        if stream not in PURPOSES:
            raise InputError(f"stream must be one of {', '.join(PURPOSES)}, got {stream!r:.40}")
        self.stream: Purpose = stream
        tasks = checked_tasks(task, handovers)
        self.task = tasks[0]
        self.tasks = tasks
        self.num_envs = num_envs
        self.seed = seed
        self.auto_reset = auto_reset
        self.handovers = tuple(handovers)
        self.robots = robots_of(robot)
        self.overlay = self.robots[0] if self.robots else None
        if randomize and len({(moves_of(one), *sorted(one.randomization.items())) for one in self.robots}) > 1:
            raise InputError("robots that worlds take in turn must have the same latency, friction and own ranges")
        self.conditions = (bool(randomize), bool(noise))
        may_vary = solver == "jumper" and isinstance(ground, str) and ground == "plane" and block is None
        own = [with_own_ranges(each, self.overlay) if randomize else each for each in tasks]
        run = [each.in_conditions(randomize=randomize, noise=noise, ground_may_vary=may_vary) for each in own]
        self._draws_ground = any(each.draws_ground for each in run)
        terrains = [terrain for each in run if (terrain := each.terrain) is not None]
        ground = terrains[0] if terrains else ground
        init_warp()
        self.wp_device = wp.get_device(None if device is None else str(device))
        physics = [advance_kernel(self.wp_device)] if solver == "jumper" else []
        by_task = [kernels_of(each) for each in run]
        with loading_kernels([*physics, *with_blocks(by_task, auto_reset)], self.wp_device):
            self.sim = Simulation(
                num_envs, solver=solver, motors=self.task.motors, visuals=visuals, device=self.wp_device, ground=ground,
                block=BlockCfg((0.0, 0.0)) if self._draws_ground else block, tolerance=CONTACT_TOLERANCE,
                friction=self.task.randomization.nominal_friction, gravity=self.task.gravity, robot=robot or None,
                threads=threads, dt=PHYSICS_DT / refine, substeps=SUBSTEPS * refine,
                keep_momentum=any(each.keep_momentum for each in tasks),
            )  # fmt: skip
        self.device = torch.device(wp.device_to_torch(self.wp_device))
        if self.wp_device.is_cuda:
            torch.cuda.set_stream(wp.stream_to_torch(wp.get_stream(self.wp_device)))
        if self._draws_ground:
            self.sim.dynamics.robot.ground.blocks.zero_()  # until `reset` samples them
        self.physics_dt = self.sim.dt
        self.step_dt = self.sim.dt * self.sim.substeps
        self._ends_episodes = True
        self._started = False
        self._compiled = False
        self._graphs = {}
        self.step_hooks: list[Callable[[], None]] = []
        """Functions that `step` calls last, also within a captured graph; they must not change the environment."""
        self.gradients_of_step: EnvGradients | None = None
        sizes = (num_envs, self.step_dt, self.sim.substeps, self.wp_device, len(self.sim.slices))
        self.skills = [TaskRuntime(each, i, *sizes) for i, each in enumerate(run)]
        self._allocate(skill, handovers, moves_of(self.overlay))
        self._show()

    def _show(self) -> None:
        """Set the environment's public tensors (observations, reward, flags) to torch views of Warp arrays.

        Observations and reward terms are the first task's.
        """
        self.num_actions = 12
        self.actions = wp.to_torch(self._action)
        self.action = self.actions[0]
        first = self.skills[0]
        self.obs = first.obs["actor"]
        self.critic_obs = first.obs["critic"]
        self.final_obs = first.final_obs["actor"]
        self.final_critic_obs = first.final_obs["critic"]
        self.num_obs = self.obs.shape[1]
        self.num_critic_obs = self.critic_obs.shape[1]
        terms = wp.to_torch(first.term_value)
        self.reward_terms = {term.name: terms[i] for i, term in enumerate(first.task.rewards)}
        names = ("reward", "done", "timeout", "terminated", "truncated")
        self.reward, self.done, self.timeout, ended, cut = (wp.to_torch(getattr(self.episodes, name)) for name in names)
        self._step = Step(first.obs, self.reward, ended, cut, {"final_obs": first.final_obs, "time_outs": self.timeout})

    # ------------------------------------------------------------------ episodes and steps

    @locked
    def reset(
        self, seed: int | None = None, *, worlds: Values | None = None
    ) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Begin a new episode in every world; return (observations by group, extras), extras being empty.

        seed: restart all random streams and the curriculum as in a new environment with this seed; graphs captured
        elsewhere keep the old one. worlds: reset only these, (num_envs,) bool or indices; the others continue, with
        new commands where due. A reset of all worlds ends the mode of `evaluation_reset`.
        Raises InputError (a ValueError): invalid seed or worlds, or both given. RuntimeError: worlds before the first
        reset of all.
        """
        mask = self._all if worlds is None else self._array(arrays.checked_worlds(worlds, self.num_envs))
        if worlds is not None and seed is not None:
            raise InputError("a seed resets all worlds: call reset(seed), or reset(worlds=...) without a seed")
        if worlds is not None and not self._started:
            raise RuntimeError("reset all worlds before the first reset of selected worlds")
        if seed is not None:
            self._start_over(check_seed(seed))
        self._ends_episodes = self._ends_episodes or worlds is None
        self.compile()  # `evaluation_reset` compiles no reset kernel
        self._advance_rng(self._part(), mask)
        self._reset_worlds(self._part(), mask)
        self._observe(self._part(), after_reset=int(worlds is not None))
        self._clear_results(mask)
        self._restart_gradients()
        return self._step.obs, {}

    @locked
    def use_reset_mask(self) -> torch.Tensor:
        """Make `step` reset worlds of a mask instead of ended ones; return the mask, (num_envs,) float32, 0 at first.

        Where the mask is not 0, a step ignores the action and begins a new episode; it counts in no metric, and
        `reward`, `done` and the like keep their values. Call this before the first reset.
        Raises InputError (a ValueError): the environment has several tasks, or was reset already.
        """
        if self._started:
            raise InputError("use_reset_mask must be called before the first reset")
        if len(self.tasks) > 1:
            raise InputError(f"a reset mask needs an environment of one task, this one has {len(self.tasks)}")
        self._reset_mask = wp.zeros(self.num_envs, dtype=float, device=self.wp_device)
        return wp.to_torch(self._reset_mask)

    @locked
    def compile(self) -> None:
        """Compile all kernels of `reset` and `step` in parallel; the first `reset` calls this itself."""
        if not self._compiled:
            load_kernels(self.kernels(), self.wp_device)
            self._compiled = True

    def _start_over(self, seed: int) -> None:
        """Restore episodes, curriculum and task states to those of a new environment with this seed."""
        self.seed = self.episodes.seed = seed
        self._started = False
        self._graphs.clear()  # they hold the old seed
        for array, value in ((self.episodes.step_count, arrays.FIRST_STEP_COUNT), (self.episodes.requested_task, -1),
                             (self.episodes.has_command, 0), (self.episodes.level, 0),
                             (self.episodes.streak, 0)):  # fmt: skip
            array.fill_(value)
        self.episodes.skill.assign(self._first_skill)
        for skill in self.skills:
            skill.states.zero_()
            for name in Counters.vars:
                getattr(skill.counters, name).zero_()

    def step(self, action: torch.Tensor) -> Step:
        """Advance one policy step; the next step overwrites the returned tensors, so clone those you need later.

        action: (num_envs, 12) floating point, clamped to -1..1; with several tasks (tasks, num_envs, 12), of which each
        world uses the row of its task. A non-finite action ends the episode as `diverged`.
        Raises InputError (a ValueError): an action of another shape, dtype or device. RuntimeError: not yet reset.
        """
        return self.step_values(action) if self.gradients_of_step is None else self.gradients_of_step.step(action)

    def gradients(self) -> EnvGradients:
        """Return a context in which `step` returns rewards and the policy's observations with gradients, as tensors.

        They reach back over the steps of the context to actions and to the state at its beginning, or at the last call
        of `reset`, `evaluation_reset`, `load_state_dict` or the context's `restart`. Values are the same as without
        gradients.
        Raises InputError (a ValueError): several tasks, another solver or moving blocks.
        """
        return EnvGradients(self)

    def _restart_gradients(self) -> None:
        """End the gradients of a context of `gradients` at the current state, which no step has made."""
        if self.gradients_of_step is not None:
            self.gradients_of_step.restart()

    def step_values(self, action: torch.Tensor, after_physics: Callable[[], None] | None = None) -> Step:
        """Advance one policy step without gradients; as `step` outside of `gradients`.

        after_physics: called before rewards and resets; it must not change the environment.
        """
        if not self._started:
            raise RuntimeError("call reset before the first step")
        several = len(self.skills) > 1
        shape = (len(self.skills), self.num_envs, 12) if several else (self.num_envs, 12)
        (self.actions if several else self.action).copy_(arrays.checked_action(action, shape, self.device))
        if self.wp_device.is_cuda and torch.cuda.is_current_stream_capturing():
            locked(self._launch_step)()
        elif after_physics is None:
            self._replay(STAGES)
        else:
            self._replay(STAGES[:2])
            after_physics()
            self._replay(STAGES[2:])
        for hook in self.step_hooks:
            hook()
        return self._step

    def _replay(self, names: Sequence[str]) -> None:
        """Replay the captured graphs of stages of a policy step; the first call launches and captures them."""
        kind = (self.auto_reset and self._ends_episodes, *names)
        if kind in self._graphs:
            self._graphs[kind].replay()
            return
        launch = functools.partial(self._launch_step, names=names)
        with WARP_LOCK:
            launch()  # loads the modules; counts as this step
            self._graphs[kind] = SlicedGraph(launch, self.sim.slices, self.wp_device)

    # ------------------------------------------------------------------ settings, commands and hand-overs

    def set(self, name: str, value: float, skill: int = 0) -> None:
        """Change a parameter of a task's term, such as a weight, from the next step on, also in captured graphs.

        name: "section.term.number" such as `rewards.jump_height.weight`; skill: index of the task.
        Raises InputError (a ValueError): no such number or skill, or a value that the task's configuration refuses.
        """
        self._check_skill(skill)
        self.skills[skill].params.set(name, value)

    def _check_skill(self, skill: int) -> None:
        """Raise InputError unless `skill` is the index of one of the environment's tasks."""
        if not isinstance(skill, Integral) or not 0 <= skill < len(self.skills):
            raise InputError(f"skill must be an index below {len(self.skills)}, got {skill!r:.40}")

    @locked
    def evaluation_reset(self, commands: Values, headings: Values = 0.0, worlds: Values | None = None) -> None:
        """Begin episodes with given commands in the default pose and first task; `step` resets no world until `reset`.

        commands: one row a world or one for all, columns as in the `labels` of `Command`; headings [rad]:
        (num_envs,) or one for all; worlds: (num_envs,) bool, by default all.
        Raises InputError (a ValueError): values of another shape, out of bounds or, other than policy steps, infinite.
        """
        n = self.num_envs
        chosen = arrays.checked_mask(worlds, self.num_envs)
        values = arrays.checked_commands(commands, chosen, [self.tasks[i] for i in np.unique(self._first_skill)])
        yaws = self._array(arrays.checked_values(headings, (n,), "headings"))
        mask = self._array(chosen)
        self._ends_episodes = False
        if not self._started:
            load_kernels(self.kernels(draws=False), self.wp_device)
        if self._draws_ground:
            for world in np.flatnonzero(chosen).tolist():
                self._scene.ground.blocks[world : world + 1].zero_()
        self._advance_rng(self._part(), mask)
        self._restore_first_task(self._part(), mask)
        self._randomize(self._part(), mask)
        inputs = [mask, yaws, self._scene, self._settings, self.episodes.skill, self.robot]
        self._launch(default_pose_kernel, n, inputs)
        self._clear_history(self._part(), mask)
        self._set_commands(mask, 1, values, yaws)
        self._observe(self._part(), after_reset=int(worlds is not None))
        self._clear_results(mask)
        self._restart_gradients()

    @locked
    def command(self, commands: Values, worlds: Values | None = None) -> None:
        """Set the tasks' commands (such as goals or velocities) within running episodes, and update `obs`.

        commands: as in `evaluation_reset`, relative to the current base position and yaw; worlds: (num_envs,) bool, by
        default all. Raises InputError (a ValueError): values of another shape, out of bounds or not finite.
        """
        chosen = arrays.checked_mask(worlds, self.num_envs)
        self._set_commands(self._array(chosen), 0, arrays.checked_commands(commands, chosen, self.tasks), self._all)
        self._observe(self._part(), after_reset=1)

    @locked
    def request(self, skill: int, worlds: Values | None = None, commands: Values | None = None) -> None:
        """Request that worlds switch to another skill as soon as the condition of a handover holds.

        skill: index of the task. worlds: (num_envs,) bool, by default all. commands: as in `evaluation_reset`, set at
        the handover relative to the base position and yaw of that moment; by default the handover's `begin` sets one.
        Raises InputError (a ValueError): no such skill, or commands of another shape, out of bounds or not finite.
        """
        self._check_skill(skill)
        mask = arrays.checked_mask(worlds, self.num_envs)
        values = np.zeros((self.num_envs, 4), dtype=np.float32)
        if commands is not None:
            values = arrays.checked_commands(commands, mask, [self.tasks[skill]])
        mask = mask > 0.0
        for array, new in ((self.episodes.requested_task, skill),
                           (self.episodes.has_command, int(commands is not None)),
                           (self.episodes.pending_command, values[mask])):  # fmt: skip
            host_values = array.numpy()
            host_values[mask] = new
            array.assign(host_values)

    def _array(self, values: np.ndarray) -> wp.array:
        """Copy values to a float array on the environment's device, for a kernel launch."""
        return wp.array(values, dtype=float, device=self.wp_device)

    # ------------------------------------------------------------------ observed values and saved states

    @locked
    def task_arrays(self, skill: int = 0) -> dict[str, np.ndarray]:
        """Return the fields of every world's state of a task as arrays (num_envs, ...) (waits for the device).

        Also, of all worlds: base_pos [m], base_vel [m/s] of the centre of mass, base_quat (xyzw), done, termination
        (index, -1: none), level. Raises InputError (a ValueError): no such skill.
        """
        self._check_skill(skill)
        state = records(self.skills[skill].states)
        values = {name: np.array(state[name]) for name in state.dtype.names or ()}
        q, qd = self.sim.joint_q(), self.sim.joint_qd()
        values |= {"base_pos": q[:, :3].copy(), "base_quat": q[:, 3:7].copy(), "base_vel": qd[:, :3].copy()}
        return values | {name: getattr(self.episodes, name).numpy().copy() for name in OF_EPISODE}

    @locked
    def snapshot(self) -> Snapshot:
        """Return the robots' current state and parameters for `jumper_warp.diff`; does not wait for the device."""
        sim = self.sim
        n = self.num_envs
        past = wp.to_torch(self.delays.target_history)  # ring by policy step
        age = torch.arange(len(past), 0, -1, device=self.device)
        row = (wp.to_torch(self.episodes.step_count).long() - age[:, None]) % len(past)
        parameters = {name: wp.to_torch(getattr(sim.motors, name)) for name in MOTOR_CONSTANTS}
        dynamics = sim.dynamics
        return Snapshot(
            tasks=tuple(skill.task for skill in self.skills),
            solver=sim.dynamics.solver_name,
            blocks=dynamics.robot.ground.blocks.shape[0] > 0,
            model=sim.model,
            dt=sim.dt,
            substeps=sim.substeps,
            default_angle=wp.to_torch(self.robot.default_angle),
            com=wp.to_torch(self.robot.body_com).view(n, -1, 3)[:, 0],
            parameters=parameters
            | {"table": wp.to_torch(dynamics.robot.table), "latency": wp.to_torch(self.parameters.latency) * sim.dt},
            q=compact_columns(wp.to_torch(self.robot.joint_q).view(n, -1), 7),
            qd=compact_columns(wp.to_torch(self.robot.joint_qd).view(n, -1), 6),
            initial_target=past[row, :, torch.arange(n, device=self.device)].mT,
            impulse=wp.to_torch(self.robot.impulse),
            action=wp.to_torch(self.robot.action),
            torque=wp.to_torch(self.robot.torque),
            wrench=wp.to_torch(self.robot.body_f).view(n, -1, 6)[:, 0].T,
        )

    @locked
    def metrics(self) -> dict[str, float]:
        """Return training metrics by name since the last call, see `TaskRuntime.metrics`, and clear the counters.

        Waits for the device. Names of tasks other than the first begin with the task's name and a slash.
        """
        metrics = self.skills[0].metrics()
        for skill in self.skills[1:]:
            metrics |= {f"{skill.task.name}/{name}": value for name, value in skill.metrics().items()}
        levels = np.bincount(self.episodes.level.numpy(), minlength=len(self.task.levels) + 1)
        fractions = levels / self.num_envs
        return metrics | {f"Curriculum/fraction_at_level_{i}": float(part) for i, part in enumerate(fractions)}

    def non_finite(self) -> list[NonFiniteValue]:
        """Return the first non-finite value of each reward, observation and curriculum term, and of the state.

        Each term is returned once. Waits for the device. A termination is true or false, so that it has no such value;
        a state or an action that is not finite ends the episode as `terminations.diverged`.
        """
        return [value for skill in self.skills for value in skill.non_finite()]

    def mirror(self, what: str, plane: str = "left-right") -> Mirror:
        """Return the mirror image (order, signs) of the first task's "observation", or of an "action".

        Arguments and errors: as `mirror_image`.
        """
        return mirror_image(self.task, what, plane)

    def config(self) -> dict:
        """Return all settings that define the environment as JSON data.

        `task` and `interface` are those of the first task; with several tasks, `tasks`, `first_skill` and `handovers`
        (names of functions) are added; with a robot overlay, `robot`, and `ranges` of the first task if randomised.
        """
        config = {
            "task": task_to_json(self.task),
            "interface": interface(self.task, self.sim.descriptions[0]),
            "num_envs": self.num_envs,
            "seed": self.seed,
            "physics_dt_s": self.physics_dt,
            "policy_dt_s": self.step_dt,
            "contact_tolerance_m_s": CONTACT_TOLERANCE,
            "solver": self.sim.dynamics.solver_name,
            "randomize": self.conditions[0],
            "noise": self.conditions[1],
            "quaternion_order": "xyzw",
        }
        if self.overlay is not None:
            config = {"robot": self.overlay.to_json(), **config}
            config |= {"ranges": ranges_of(self.task, self.overlay)} if self.conditions[0] else {}
        if len(self.tasks) == 1:
            return config
        return {
            "tasks": [task_to_json(task) for task in self.tasks],
            "first_skill": self._first_skill.tolist(),
            "handovers": [handover_to_json(handover) for handover in self.handovers],
            **config,
        }

    @locked
    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the complete state that the next step depends on; see `jumper_warp.envs.state.save_state`."""
        return save_state(self)

    @locked
    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Restore a saved state, so that later steps are bitwise the same; see `jumper_warp.envs.state.load_state`."""
        load_state(self, state)
        self._started = bool((self.episodes.step_count.numpy() > arrays.FIRST_STEP_COUNT).all())
        self.sim.dynamics.parameters_changed()
        self._restart_gradients()

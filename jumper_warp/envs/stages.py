"""Kernel launches of an environment's policy step and resets, in order, with their arrays.

`part` is the range of worlds of a launch: all on a GPU, a slice per thread on a CPU. `mask` (num_envs,) is not 0 where
a launch acts, so that the host makes no decision and a step can be a captured graph. A skill is a task in an
environment of several.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from jumper_warp.envs import arrays
from jumper_warp.envs.parameters import robot_parameters
from jumper_warp.envs.skill import TaskRuntime
from jumper_warp.kernels.mdp import attempts, events
from jumper_warp.kernels.mdp.actions import action_kernel
from jumper_warp.kernels.mdp.env import EpisodeArrays, SkillSettings
from jumper_warp.kernels.mdp.events import AT_RESET, AT_STEP, STARTUP
from jumper_warp.kernels.mdp.handover import NONE, make_handover_kernel, restore_task_kernel, set_skill_kernel
from jumper_warp.kernels.mdp.observe import LANES, postprocess_obs_kernel
from jumper_warp.kernels.mdp.parameters import motors_kernel
from jumper_warp.kernels.mdp.reset import advance_rng_kernel, clear_history_kernel
from jumper_warp.kernels.mdp.track import track_kernel
from jumper_warp.sim.dynamics import WorldRange, check_worlds
from jumper_warp.sim.simulation import Simulation
from jumper_warp.tasks.cfg import Handover, TaskCfg
from jumper_warp.tasks.overlay_ranges import RangeMoves
from jumper_warp.utils.copying import Uncopied
from jumper_warp.utils.kernels import Kernel, KernelStruct
from jumper_warp.utils.streams import Purpose

STAGES = ("action", "physics", "episode", "observe", "reset")  # of a policy step, in order; see `Env.stages`
BLOCK = 32  # Default threads of a block; small, to spread a few thousand heavy threads over all multiprocessors
BLOCKS = {"reset": 128, "event": 256}  # Threads of a block of task kernels by name, where other than BLOCK
POSTPROCESS_BLOCK = 256
EVENT_BLOCKS = 264
"""Largest number of blocks of event kernels. Most threads are idle, and a new block costs more than another pass."""


def with_blocks(by_task: Sequence[dict[str, Kernel]], draws: bool) -> list[tuple[Kernel, int]]:
    """Return the kernels that any environment launches, with block sizes; the slowest compile first.

    by_task: kernels of each task, see `kernels_of`. draws: include those of `reset`, else those of `evaluation_reset`.
    """
    names = ("reset" if draws else "set_command", "step", "observe", "event")
    shared = [track_kernel, action_kernel, motors_kernel, clear_history_kernel, advance_rng_kernel]
    kernels = [(kernels[name], BLOCKS.get(name, BLOCK)) for name in names for kernels in by_task]
    return [*kernels, *((kernel, BLOCK) for kernel in shared), (postprocess_obs_kernel, POSTPROCESS_BLOCK)]


class WorldSlice(NamedTuple):
    """Contiguous range of worlds for which kernels of a policy step are launched, with its episode arrays."""

    first: int
    count: int
    episode: KernelStruct  # The kernels' `EpisodeArrays` that begin at `first`


def _changed(episode: KernelStruct, **numbers: int) -> KernelStruct:
    """Return a copy of `EpisodeArrays`, of the same arrays, with some of its numbers changed."""
    changed = EpisodeArrays()
    for name in EpisodeArrays.vars:
        setattr(changed, name, numbers.get(name, getattr(episode, name)))
    return changed


class Stages(Uncopied):
    """Arrays and kernel launches of an environment; `Env` adds the public methods."""

    sim: Simulation
    tasks: tuple[TaskCfg, ...]
    skills: list[TaskRuntime]
    num_envs: int
    seed: int
    stream: Purpose
    step_dt: float
    wp_device: wp.Device
    auto_reset: bool
    conditions: tuple[bool, bool]  # `randomize` and `noise` of the constructor
    _started: bool  # Whether `reset` or `evaluation_reset` has begun the first episodes
    _ends_episodes: bool  # Whether ended episodes are reset; false after `evaluation_reset`

    def _allocate(self, skill: np.ndarray | int, handovers: Sequence[Handover], moves: RangeMoves) -> None:
        """Allocate the arrays that all tasks share; skill: index of each world's first task, (num_envs,) or one.

        moves: differences of the robot from the described one.
        """
        n = self.num_envs
        tasks = tuple(each.task for each in self.skills)
        device = self.wp_device
        sim = self.sim
        wp.copy(sim.state.joint_q, sim.model.joint_q)  # ankle quaternions too, which only the default pose writes
        self._first_skill = arrays.checked_skill(skill, n, len(tasks))
        active, self._home = (wp.array(self._first_skill, dtype=int, device=device) for _ in range(2))
        self.parameters = robot_parameters(sim, tasks, active, moves)
        self.robot = arrays.robot_arrays(sim, self.step_dt)
        self._scene = arrays.scene_of(sim)
        self.episodes = arrays.episode_arrays(n, self.seed, self.stream, active, device)
        self.delays = arrays.delay_arrays(n, self.parameters.latency, sim.substeps, device)
        for each in self.skills:
            each.observations.latency = self.parameters.observation_latency
        settings = [each.settings_of_skill() for each in self.skills]
        self._settings = wp.array(settings, dtype=SkillSettings, device=device)
        self._action = wp.zeros((len(tasks), n, 12), dtype=float, device=device)
        self._all = wp.full(n, 1.0, dtype=float, device=device)
        self._moved = wp.zeros(n, dtype=int, device=device)
        self._reset_mask = self.episodes.done  # worlds that `step` resets, by `Env.use_reset_mask` an array of its own
        self._handovers = [
            (make_handover_kernel(h), self.tasks.index(h.source), self.tasks.index(h.target)) for h in handovers
        ]

    def kernels(self, draws: bool = True) -> list[tuple[Kernel, int]]:
        """Return the kernels of `step`, and of `reset` if draws, else `evaluation_reset`, each with its block size."""
        shared = [restore_task_kernel] if len(self.skills) > 1 else []
        shared += [set_skill_kernel] if self._reset_mask is not self.episodes.done else []
        shared += [kernel for kernel, _, _ in self._handovers]
        kernels = with_blocks([skill.kernels for skill in self.skills], draws)
        return [*kernels, *((kernel, BLOCK) for kernel in shared), *self.sim.dynamics.step_kernels()]

    def _part(self, worlds: WorldRange | None = None) -> WorldSlice:
        """Return a range of worlds (default: all) with the `EpisodeArrays` that begin at its first world."""
        worlds = check_worlds(worlds, self.num_envs)
        if worlds.count == self.num_envs:
            return WorldSlice(0, self.num_envs, self.episodes)
        index = self.sim.slices.index(worlds) if worlds in self.sim.slices else 0
        return WorldSlice(*worlds, _changed(self.episodes, first=worlds.first, slice=index))

    def stages(self, worlds: WorldRange | None = None) -> dict[str, Callable[[], None]]:
        """Return the stages of a policy step by name, in order: functions that launch some kernels without waiting.

        worlds: range of worlds, by default all; no stage reads or writes data of worlds outside the range. Raises
        InputError (a ValueError): a range beyond the worlds.
        """
        part = self._part(worlds)
        return {"action": lambda: self._apply_actions(part), "physics": lambda: self._advance_physics(part),
                "episode": lambda: self._compute_rewards_and_dones(part),
                "observe": lambda: self._observe(part, after_reset=0),
                "reset": lambda: self._reset_done(part)}  # fmt: skip

    def _launch_step(self, worlds: WorldRange | None = None, names: Sequence[str] = STAGES) -> None:
        """Launch stages of a policy step, by default all, for a range of worlds (default: all)."""
        stages = self.stages(worlds)
        for name in names:
            stages[name]()

    def _apply_actions(self, part: WorldSlice) -> None:
        """Convert actions to motor targets and wrenches, then run interval events."""
        inputs = [self._action, self._settings, self.parameters.push, self.robot, part.episode, self.delays]
        self._launch(action_kernel, (5, part.count), inputs)
        self._events(part, AT_STEP, self._all)

    def _advance_physics(self, part: WorldSlice) -> None:
        """Advance the physics by one policy step, then update paw kinematics, contacts and collisions.

        `bodies=False`: SolverJumper does not write passive joints, and poses and velocities of bodies, since no stage
        reads them. `Simulation.write_bodies` computes them.
        """
        delays = self.delays
        self.sim.advance(
            self.sim.substeps, delays.current_target, delays.prev_target, delays.switch_step, bodies=False,
            worlds=WorldRange(part.first, part.count),
        )  # fmt: skip
        self._track(part)

    def _track(self, part: WorldSlice) -> None:
        """Update paw kinematics, contacts and collisions after the physics of a policy step."""
        inputs = [self._scene.geometry, self._scene.ground, self._settings, part.episode, self.robot]
        self._launch(track_kernel, (4, part.count), inputs)

    def _compute_rewards_and_dones(self, part: WorldSlice) -> None:
        """Advance the task states, and evaluate terminations, rewards and curriculum of every task."""
        ended_before = self._reset_mask is not self.episodes.done
        if ended_before:
            self._launch(set_skill_kernel, part.count, [self._reset_mask, NONE, part.episode])
        for skill in self.skills:
            self._launch(
                skill.kernels["step"], part.count,
                [skill.index, self.robot, self._scene.ground, len(skill.task.levels), skill.params.values,
                 skill.observations.raw, part.episode, skill.states, skill.episode_sum, skill.found, skill.found_states,
                 skill.term_value, skill.counters],
            )  # fmt: skip
        if ended_before:
            self._launch(set_skill_kernel, part.count, [self._reset_mask, 0, part.episode])
            self._advance_rng(part, self._reset_mask)

    def _reset_done(self, part: WorldSlice) -> None:
        """Switch worlds to another task where due, reset ended episodes (with auto_reset), and observe both again."""
        self._hand_over(part)
        begins = self.auto_reset and self._ends_episodes
        if begins and not self._handovers and self._reset_mask is self.episodes.done:
            part = part._replace(episode=_changed(part.episode, listed_only=1))
        if begins:
            self._reset_worlds(part, self._reset_mask)
        if self._handovers or begins:
            self._observe(part, after_reset=1)

    def _hand_over(self, part: WorldSlice) -> None:
        """Switch worlds from one task to another where a handover is due, at most once in a step."""
        if self._handovers:
            self._moved[part.first : part.first + part.count].zero_()
        for kernel, source, target in self._handovers:
            self._launch(
                kernel, part.count,
                [source, target, self._scene, self._settings, self._moved, self.robot, self.parameters,
                 part.episode, self.skills[source].states, self.skills[target].states],
            )  # fmt: skip

    def _reset_worlds(self, part: WorldSlice, mask: wp.array) -> None:
        """Begin new episodes in the first skill where mask (num_envs,) is nonzero, and sample commands where due."""
        self._restore_first_task(part, mask)
        self._randomize(part, mask)
        for skill in self.skills:
            lanes = attempts.LANES if self.wp_device.is_cuda and skill.task.reset.parallel else 1
            self._launch(
                skill.kernels["reset"], (part.count, lanes),
                [skill.index, lanes, mask, self._scene, self._settings, skill.settings, skill.levels, part.episode,
                 skill.states, self.robot], BLOCKS["reset"],
            )  # fmt: skip
        self._clear_history(part, mask)

    def _restore_first_task(self, part: WorldSlice, mask: wp.array) -> None:
        """Switch worlds back to their first task, and clear requests of other tasks, where mask is nonzero."""
        if len(self.skills) > 1:
            self._launch(restore_task_kernel, part.count, [mask, self._home, self.parameters, part.episode])

    def _randomize(self, part: WorldSlice, mask: wp.array) -> None:
        """Randomise robot parameters where mask is nonzero, by the reset events.

        Before the very first reset run the startup events too.
        """
        if not self._started:  # all worlds begin
            self._launch(motors_kernel, (12, self.num_envs), [self.parameters])
            self._events(part, STARTUP, self._all)
            self._started = True
        self._events(part, AT_RESET, mask)

    def _events(self, part: WorldSlice, stage: int, mask: wp.array) -> None:
        """Run the events (changes of robot parameters) that are due where mask is nonzero, and update the solver.

        stage: STARTUP, AT_RESET or AT_STEP.
        """
        for skill in self.skills:
            slots = enumerate(skill.task.params.slots["events"])
            due = {i: slot for i, slot in slots if slot.term.due_at(stage)}
            if due:
                parallel = self.wp_device.is_cuda and any(slot.parallel for slot in due.values())
                first = min(due)
                lanes = events.LANES if parallel else 1
                self._launch(
                    skill.kernels["event"], (max(due) - first + 1, lanes, part.count),
                    [skill.index, stage, first, lanes, mask, self.step_dt, part.episode, skill.params.values,
                     skill.timer, self.parameters], BLOCKS["event"], EVENT_BLOCKS,
                )  # fmt: skip
            if any(slot.update_solver for slot in due.values()):
                self.sim.dynamics.parameters_changed(mask, WorldRange(part.first, part.count))

    def _clear_history(self, part: WorldSlice, mask: wp.array) -> None:
        """Clear actions, contacts, delays and the solver's warm start where mask is nonzero."""
        inputs = [part.first, mask, self._scene.geometry, self.robot, self.delays]
        self._launch(clear_history_kernel, (12, part.count), inputs)
        self.sim.dynamics.after_reset(mask)

    def _clear_results(self, mask: wp.array) -> None:
        """Clear the last step's reward, reward terms and end flags where mask (num_envs,) is nonzero."""
        begun = wp.to_torch(mask) != 0.0
        episodes = self.episodes
        for name in ("reward", "done", "timeout", "terminated", "truncated", "termination"):
            wp.to_torch(getattr(episodes, name)).masked_fill_(begun, -1 if name == "termination" else 0)
        for array in (array for skill in self.skills for array in (skill.term_value, skill.episode_sum)):
            wp.to_torch(array).masked_fill_(begun, 0.0)

    def _advance_rng(self, part: WorldSlice, mask: wp.array) -> None:
        """Increment the step count of masked worlds, so that their next reset draws other random numbers."""
        self._launch(advance_rng_kernel, part.count, [mask, part.episode])

    def _observe(self, part: WorldSlice, after_reset: int) -> None:
        """Write observations; after_reset 1: only where an episode, skill or command just began, not `final_obs`."""
        for skill in self.skills:
            observed = skill.observations
            self._launch(
                skill.kernels["observe"], (skill.num_chunks, part.count),
                [skill.index, self.robot, self.parameters, self._scene.ground, part.episode, skill.states,
                 skill.params.values, after_reset, skill.term_value, observed.raw, skill.found, skill.found_states],
            )  # fmt: skip
            inputs = [skill.index, part.episode, skill.columns, skill.params.values, after_reset, observed]
            self._launch(postprocess_obs_kernel, (part.count, int(LANES)), inputs, POSTPROCESS_BLOCK)

    def _launch(
        self, kernel: Kernel, dim: int | tuple[int, ...], inputs: list, block: int = BLOCK, blocks: int = 0
    ) -> None:
        """Launch a kernel; block: threads per block; blocks: largest number of blocks on a GPU, 0 for no limit."""
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.wp_device, block_dim=block, max_blocks=blocks)

    def _set_commands(self, mask: wp.array, begins: int, values: np.ndarray, headings: wp.array) -> None:
        """Set tasks' commands (num_envs, 4) where mask is nonzero; begins 1: of new episodes with headings [rad].

        In a new episode, a gait frequency of 0, the fourth value, becomes the task's.
        """
        for skill in self.skills:
            gait = (0.0, 0.0, 0.0, begins * getattr(skill.task.reset.settings, "gait", 0.0))
            commands = wp.array(np.where(values == 0.0, gait, values), dtype=wp.vec4, device=self.wp_device)
            self._launch(
                skill.kernels["set_command"], self.num_envs,
                [skill.index, mask, begins, commands, headings, self._scene, self.robot, self.episodes, skill.states],
            )  # fmt: skip

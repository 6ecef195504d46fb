"""The stages of a policy step: what is launched, in which order, on which arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from jumper_warp.envs.arrays import FIRST_CLOCK, checked_skill, delay_arrays, env_arrays, robot_arrays, scene_of
from jumper_warp.envs.parameters import robot_parameters
from jumper_warp.envs.skill import Skill
from jumper_warp.sim.simulation import Simulation
from jumper_warp.tasks.cfg import Handover, TaskCfg
from kernels.mdp import attempts, events
from kernels.mdp.actions import action_kernel
from kernels.mdp.env import SkillSettings
from kernels.mdp.events import AT_RESET, AT_STEP, STARTUP
from kernels.mdp.handover import make_handover_kernel
from kernels.mdp.observe import LANES, condition_kernel
from kernels.mdp.parameters import motors_kernel
from kernels.mdp.reset import forget_kernel, tick_kernel
from kernels.mdp.track import track_kernel


class Stages:
    """What an environment launches. It holds all arrays; `Env` is the side that its users see."""

    sim: Simulation
    tasks: tuple[TaskCfg, ...]
    num_envs: int
    seed: int
    step_dt: float
    wp_device: wp.Device
    auto_reset: bool
    _started: bool
    """Whether `reset` or `evaluation_reset` has begun the first episodes."""
    _ends_episodes: bool
    """Whether ended episodes begin anew; not while a policy is measured."""

    def _allocate(self, tasks: Sequence[TaskCfg], skill: np.ndarray | int, handovers: Sequence[Handover]) -> None:
        """Make all arrays and kernels; skill: index of the task that each world begins in."""
        n, device, sim = self.num_envs, self.wp_device, self.sim
        self._first_skill = active = checked_skill(skill, n, len(tasks))
        active = wp.array(active, dtype=int, device=device)
        self.skills = [Skill(task, i, n, self.step_dt, sim.substeps, device) for i, task in enumerate(tasks)]
        self.parameters = robot_parameters(sim, tuple(tasks), active)
        self.robot, self._scene = robot_arrays(sim, self.step_dt), scene_of(sim)
        self.worlds = env_arrays(n, self.seed, active, device)
        self.delays = delay_arrays(n, self.parameters.latency, sim.substeps, device)
        for each in self.skills:
            each.observations.latency = self.parameters.observation_latency
        settings = [each.settings_of_skill() for each in self.skills]
        self._settings = wp.array(settings, dtype=SkillSettings, device=device)
        self._action = wp.zeros((len(tasks), n, 12), dtype=float, device=device)
        self._all = wp.full(n, 1.0, dtype=float, device=device)
        self._moved = wp.zeros(n, dtype=int, device=device)
        self._handovers = [
            (make_handover_kernel(h), self.tasks.index(h.source), self.tasks.index(h.target)) for h in handovers
        ]

    def restored(self) -> None:
        """Let the solver read parameters that were put back."""
        self._started = bool((self.worlds.clock.numpy() > FIRST_CLOCK).all())
        self.sim.physics.parameters_changed()

    def _launch_step(self) -> None:
        for stage in self.stages().values():
            stage()

    def stages(self) -> dict[str, Callable[[], None]]:
        """Return the parts of a step by name, in order: each launches its kernels and does not wait for them."""
        return {"action": self._act, "physics": self._advance, "episode": self._judge,
                "observe": lambda: self._observe(beginning=0), "reset": self._renew}  # fmt: skip

    def _act(self) -> None:
        n, robot, env, settings = self.num_envs, self.robot, self.worlds, self._settings
        delays, push = self.delays, self.parameters.push
        self._launch(action_kernel, (n, 4), [self._action, settings, push, robot, env, delays])
        self._events(AT_STEP, self._all)

    def _advance(self) -> None:
        delays, scene = self.delays, self._scene
        self.sim.physics.advance(
            self.sim.substeps, delays.late_target, delays.earlier_target, delays.late_steps, bodies=False
        )
        inputs = [scene.geometry, scene.ground, self._settings, self.worlds, self.robot]
        self._launch(track_kernel, (4, self.num_envs), inputs)

    def _judge(self) -> None:
        for skill in self.skills:
            self._launch(
                skill.kernels["step"], self.num_envs,
                [skill.index, self.robot, self._scene.ground, len(skill.task.levels), skill.numbers, self.worlds,
                 skill.states, skill.term_value, skill.counters],
            )  # fmt: skip

    def _renew(self) -> None:
        self._hand_over()
        begins = self.auto_reset and self._ends_episodes
        if begins:
            self._begin(self.worlds.done)
        if self._handovers or begins:
            self._observe(beginning=1)

    def _hand_over(self) -> None:
        if self._handovers:
            self._moved.zero_()
        for kernel, source, target in self._handovers:
            self._launch(
                kernel, self.num_envs,
                [source, target, self._scene.ground, self._settings, self._moved, self.robot, self.parameters,
                 self.worlds, self.skills[source].states, self.skills[target].states],
            )  # fmt: skip

    def _begin(self, mask: wp.array) -> None:
        """Begin new episodes where mask is not 0, and commands where they are due."""
        self._draw(mask)
        for skill in self.skills:
            lanes = attempts.LANES if self.wp_device.is_cuda and skill.task.reset.side_by_side else 1
            self._launch(
                skill.kernels["reset"], (self.num_envs, lanes),
                [skill.index, lanes, mask, self._scene, self._settings, skill.settings, skill.levels, self.worlds,
                 skill.states, self.robot], block_dim=128,
            )  # fmt: skip
        self._forget(mask)

    def _draw(self, mask: wp.array) -> None:
        """Draw parameters of episodes that begin where mask is not 0."""
        if not self._started:
            self._launch(motors_kernel, (12, self.num_envs), [self.parameters])
            self._events(STARTUP, self._all)
            self._started = True
        self._events(AT_RESET, mask)

    def _events(self, stage: int, mask: wp.array) -> None:
        """Run the events of a stage, and let the solver read what they changed."""
        for skill in self.skills:
            due = [row.term for row in skill.task.rows["events"] if row.term.due_at(stage)]
            if due:
                lanes = events.LANES if self.wp_device.is_cuda else 1
                self._launch(
                    skill.kernels["event"], (skill.num_events, lanes, self.num_envs),
                    [skill.index, stage, lanes, mask, self.step_dt, self.worlds, skill.numbers, skill.timer,
                     self.parameters], block_dim=256,
                )  # fmt: skip
            if any(term.options["repack"] for term in due):
                self.sim.physics.parameters_changed(mask)

    def _forget(self, mask: wp.array) -> None:
        self._launch(forget_kernel, (12, self.num_envs), [mask, self._scene.geometry, self.robot, self.delays])
        self.sim.physics.after_reset(mask)

    def _tick(self, mask: wp.array) -> None:
        self._launch(tick_kernel, self.num_envs, [mask, self.worlds])

    def _observe(self, beginning: int) -> None:
        for skill in self.skills:
            arrays = skill.observations
            self._launch(
                skill.kernels["observe"], (skill.num_chunks, self.num_envs),
                [skill.index, self.robot, self.parameters, self._scene.ground, self.worlds, skill.states,
                 skill.numbers, beginning, arrays.raw],
            )  # fmt: skip
            inputs = [skill.index, self.worlds, skill.columns, skill.numbers, beginning, arrays]
            wp.launch(condition_kernel, (self.num_envs, int(LANES)), inputs, device=self.wp_device)

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list, block_dim: int = 32) -> None:
        # small blocks spread a few thousand heavy threads over all multiprocessors
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.wp_device, block_dim=block_dim)

    def _give(self, mask: wp.array, begins: int, values: np.ndarray, headings: wp.array) -> None:
        values = wp.array(values, dtype=wp.vec4, device=self.wp_device)
        for skill in self.skills:
            self._launch(
                skill.kernels["give"], self.num_envs,
                [skill.index, mask, begins, values, headings, self._scene, self.robot, self.worlds, skill.states],
            )  # fmt: skip

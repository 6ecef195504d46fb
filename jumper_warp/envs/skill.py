"""Kernels and arrays of one task in an environment."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import torch
import warp as wp

from jumper_warp.envs.arrays import FIRST_STEP_COUNT, allocate
from jumper_warp.kernels.layout import COORDS, DOFS
from jumper_warp.kernels.mdp.env import RING, Counters, NoSettings, SkillSettings
from jumper_warp.kernels.mdp.events import make_event_kernel
from jumper_warp.kernels.mdp.non_finite import NO_WORLD, NonFinite
from jumper_warp.kernels.mdp.observe import CHUNK, ObservationArrays, ObservationColumn, make_observe_kernel
from jumper_warp.kernels.mdp.reset import make_reset_kernel, make_set_command_kernel
from jumper_warp.kernels.mdp.step import make_step_kernel
from jumper_warp.kernels.mdp.view import vec12
from jumper_warp.robot.motors import filter_params
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.copying import Struct
from jumper_warp.tasks.terms import TaskParams
from jumper_warp.utils.dumps import NonFiniteValue
from jumper_warp.utils.kernels import Kernel, KernelStruct, content_hash, records
from jumper_warp.utils.threads import locked

T = TypeVar("T")
_KERNELS: dict[tuple, Kernel] = {}


class TaskRuntime:
    """Kernels and arrays of one task in an environment; attributes that are structs or arrays are kernel arguments.

    kernels: see `kernels_of`. params: numbers of the terms; `params.values` is the kernels' argument `p`. obs,
    final_obs: torch views (num_envs, columns) by group, after and before resets. timer: policy steps until each event
    happens, (events, num_envs). term_value: rewards of the last step, (rewards, num_envs); episode_sum: their sums over
    the episode. counters: statistics of ended episodes since they were last read. levels: of the curriculum.
    """

    def __init__(
        self, task: TaskCfg, index: int, num_envs: int, step_dt: float, substeps: int, device: wp.DeviceLike,
        slices: int = 1,
    ) -> None:  # fmt: skip
        """Allocate the task's arrays; index: its index in the environment; step_dt [s]: policy step of `substeps`.

        slices: number of slices of worlds.
        """
        self.task = task
        self.index = index
        self.num_envs = num_envs
        self.device = device
        self.kernels = kernels_of(task)
        self.params = ParamArrays(task.params, device)
        self.states = wp.zeros(num_envs, dtype=task.state, device=device)
        self.num_events = len(task.params.slots["events"])
        self.timer = wp.zeros((max(self.num_events, 1), num_envs), dtype=int, device=device)
        terms = (max(len(task.rewards), 1), num_envs)
        self.term_value, self.episode_sum = (wp.zeros(terms, dtype=float, device=device) for _ in range(2))
        self.counters = self._counters()
        self._max_episode_length_s = task.max_episode_length_s(step_dt)
        self.settings = self._structs([] if task.reset.settings is None else [task.reset.settings.values(step_dt)])
        self.levels = self._structs([level.values() for level in task.levels], task.level_type)
        self._allocate_observations(substeps)
        self._allocate_non_finite(slices)

    def _counters(self) -> KernelStruct:
        """Return the counters of episode statistics for the kernels, all 0."""
        n = self.num_envs
        task = self.task
        counters = Counters()
        allocate(counters, ("term_sum",), (max(len(task.rewards), 1), n), wp.float64, self.device)
        allocate(counters, ("termination_count",), (len(task.terminations), n), int, self.device)
        allocate(counters, ("curriculum_episodes", "curriculum_successes", "bad_actions"), n, int, self.device)
        allocate(counters, ("error_sum",), n, wp.float64, self.device)
        return counters

    def _structs(self, values: list, kind: Struct | None = None) -> wp.array:
        """Return kernel structs (settings or curriculum levels) as a Warp array of type `kind`.

        If there are none, it has one unused `NoSettings`.
        """
        values = values or [NoSettings()]
        return wp.array(values, dtype=kind or values[0]._cls, device=self.device)

    def _allocate_observations(self, substeps: int) -> None:
        """Allocate observation arrays, their torch views by group, and a table of each component's settings.

        A component is one number of a term; kernels read a column of the table, an `ObservationColumn`, per component.
        Groups (actor, critic) are one flat array, each (num_envs, columns); a term with a history has a column per
        frame, oldest first. `past`: columns of the ring buffer that delays the components with sensor latency.
        """
        n = self.num_envs
        task = self.task
        layouts = {group: task.layout(group) for group in task.groups}
        widths = {group: max((end for _, end in layout.values()), default=0) for group, layout in layouts.items()}
        columns = []
        start = 0
        past = 0
        for index, group in enumerate(task.groups):
            for slot in task.params.slots[f"observations.{group}"]:
                width = slot.term.width
                oldest = layouts[group][slot.term.name][0]
                delayed = int(slot.delayed)
                for j in range(width):
                    columns.append((len(columns), index, start, widths[group], slot.noise, slot.noise_limit, slot.scale,
                                    slot.clip, oldest + j, width, slot.history, delayed, past))  # fmt: skip
                    past += delayed
            start += n * widths[group]
        table = np.array(columns, dtype=np.int32).reshape(-1, len(ObservationColumn.vars))
        self.columns = wp.array(table.T, dtype=int, device=self.device)
        self.num_chunks = -(-sum(len(task.params.slots[f"observations.{group}"]) for group in task.groups) // CHUNK)
        arrays = ObservationArrays()
        allocate(arrays, ("raw",), (len(columns), n), float, self.device)
        allocate(arrays, ("now", "final"), start, float, self.device)
        allocate(arrays, ("past",), (RING, n, max(past, 1)), float, self.device)
        arrays.latency = wp.zeros(n, dtype=int, device=self.device)
        arrays.substeps = substeps
        self.observations = arrays
        self.obs, self.final_obs = (self._views(a, widths) for a in (arrays.now, arrays.final))

    def _allocate_non_finite(self, slices: int) -> None:
        """Allocate the records of non-finite values, for each slice of worlds, and the names of the terms.

        Kernels replace NaN and infinity by 0, so that training continues. They store the first such value of each term,
        with its world's state, which `non_finite` reports. Terms are numbered as in `_term_names`: rewards, curriculum,
        state (diverged), observations. A slice is a range of worlds that one CPU thread advances: records of its own
        need no atomic operations.
        """
        task = self.task
        groups = self.task.groups
        slots = [(group, slot.term) for group in groups for slot in task.params.slots[f"observations.{group}"]]
        self._term_names = [f"rewards.{term.name}" for term in task.rewards]
        self._term_names += [f"curriculum.{task.curriculum.name}", "terminations.diverged"]
        self._term_names += [f"observations.{group}.{term.name}" for group, term in slots]
        components = [f"{group}.{name}" for group, term in slots for name in term.columns[-term.width :]]
        self._names = {"rewards": [term.name for term in task.rewards], "observations": components}
        self._reported: set[int] = set()
        found = NonFinite()
        rows = slices * len(self._term_names)
        found.num_rewards = len(task.rewards)
        found.num_terms = len(self._term_names)
        found.world = wp.full(rows, NO_WORLD, dtype=int, device=self.device)
        allocate(found, ("step",), rows, int, self.device)
        allocate(found, ("value",), rows, float, self.device)
        for name, columns in (("joint_q", int(COORDS)), ("joint_qd", int(DOFS)), ("action", 12),
                              ("observations", len(components)), ("rewards", len(task.rewards))):  # fmt: skip
            allocate(found, (name,), (rows, columns), float, self.device)
        widths = [term.width for _, term in slots]
        found.observation_term = wp.array(np.repeat(np.arange(len(slots)), widths), dtype=int, device=self.device)
        self.found = found
        self.found_states = wp.zeros(rows, dtype=task.state, device=self.device)

    def non_finite(self) -> list[NonFiniteValue]:
        """Return the first non-finite value of each term, without terms of earlier calls (waits for the device)."""
        worlds = self.found.world.numpy().reshape(-1, self.found.num_terms)  # (slices, terms)
        terms = [i for i in np.flatnonzero((worlds != NO_WORLD).any(0)).tolist() if i not in self._reported]
        if not terms:
            return []
        self._reported |= set(terms)
        found = self.found
        states = records(self.found_states)
        steps = found.step.numpy().reshape(worlds.shape)
        values = found.value.numpy()
        values_by_term = []
        for i in terms:
            first = min(np.flatnonzero(worlds[:, i] != NO_WORLD), key=lambda part: (steps[part, i], worlds[part, i]))
            row = first * found.num_terms + i
            names = ("joint_q", "joint_qd", "action", "observations", "rewards")
            arrays = {name: getattr(found, name).numpy()[row].copy() for name in names}
            arrays |= {f"state.{name}": np.array(states[name][row]) for name in states.dtype.names or ()}
            step = int(steps[first, i]) - FIRST_STEP_COUNT - 1  # the first reset counts as a step
            name = self._term_names[i] if self.index == 0 else f"{self.task.name}/{self._term_names[i]}"
            values_by_term.append(
                NonFiniteValue(name, float(values[row]), int(worlds[first, i]), step, arrays, self._names)
            )
        return values_by_term

    def _views(self, array: wp.array, widths: dict[str, int]) -> dict[str, torch.Tensor]:
        """Return torch views (num_envs, columns) of observations by group; array: flat, group after group."""
        flat = wp.to_torch(array)
        first = 0
        views = {}
        for group, width in widths.items():
            views[group] = flat[first : first + self.num_envs * width].view(self.num_envs, width)
            first += self.num_envs * width
        return views

    def settings_of_skill(self) -> KernelStruct:
        """Return the task's constants as a kernel struct: action scale, command filter, collision margins."""
        lateral, transversal = (math.radians(scale) for scale in self.task.action_scale)
        settings = SkillSettings()
        settings.action_scale = vec12(*(4 * (lateral, transversal, transversal)))
        settings.command_filter = filter_params(self.task.command_filter)
        settings.contact_force = self.task.contact_force
        settings.push_in_flight = int(self.task.randomization.push_in_flight)
        settings.eval_height_offset = self.task.eval_height_offset
        settings.self_collision_margin = self.task.self_collision_margin
        settings.obstacle_margin = self.task.obstacle_margin
        return settings

    def set(self, section: str, name: str, **numbers: float) -> None:
        """Change parameters of one of the task's terms, such as its weight.

        section: kind of term, as "rewards"; name: of the term. Raises InputError as `Env.set`.
        """
        for key, value in numbers.items():
            self.params.set(f"{section}.{name}.{key}", value)

    @locked
    def metrics(self) -> dict[str, float]:
        """Return the task's metrics by name since the last call, and clear the counters (waits for the device).

        Without samples, a mean of the group Metrics is NaN, and others are 0. `Episode_Reward/<term>`: mean over the
        ended episodes of the term's sum over the episode, divided by the time limit [s]; `Episode_Sum/<term>`: the mean
        sum, of a task without a time limit. `Episode_Termination/<term>`: fraction of the ended episodes.
        `Metrics/success`: fraction of the episodes that the curriculum counts; `Metrics/error_of_successes_<unit>`:
        mean curriculum error of the successful ones. `Metrics/bad_actions`: number of policy steps with a non-finite
        action, over all worlds. Each `StateMetric` of the task adds its `name`. One with `per` also sets its two fields
        in the task states of all worlds to 0.
        """
        task = self.task
        counters = self.counters
        metrics = {}
        endings = counters.termination_count.numpy().sum(axis=1)
        ended = max(int(endings.sum()), 1)
        limit = self._max_episode_length_s
        # not strict: `term_sum` has one row, which stays 0, if the task has no rewards
        for term, total in zip(task.rewards, counters.term_sum.numpy().sum(axis=1), strict=False):
            metrics[f"Episode_{'Reward' if limit else 'Sum'}/{term.name}"] = float(total) / ended / (limit or 1.0)
        for term, count in zip(task.terminations, endings, strict=True):
            metrics[f"Episode_Termination/{term.name}"] = float(count) / ended
        counted = int(counters.curriculum_episodes.numpy().sum())
        succeeded = int(counters.curriculum_successes.numpy().sum())
        metrics["Metrics/success"] = succeeded / counted if counted else math.nan
        error = float(counters.error_sum.numpy().sum()) / succeeded if succeeded else math.nan
        metrics[f"Metrics/error_of_successes_{task.curriculum.options['unit']}"] = error
        metrics["Metrics/bad_actions"] = float(counters.bad_actions.numpy().sum())
        for name in Counters.vars:
            getattr(counters, name).zero_()
        return metrics | self._state_metrics()

    def _state_metrics(self) -> dict[str, float]:
        """Return the metrics of the training log that come from the worlds' task states, and clear their sums.

        A `StateMetric` is the sum of `field` over the sum of `per`, or the mean; values that are not finite count as 0.
        """
        metrics = self.task.metrics
        values_by_name = {}
        if not metrics:
            return values_by_name
        states = records(self.states).copy()
        for metric in metrics:
            values, per = (_finite(states, field) for field in (metric.field, metric.per or metric.field))
            total = self.num_envs if metric.per is None else float(per.sum())
            values_by_name[metric.name] = float(values.sum()) / total if total else math.nan
        for metric in metrics:
            if metric.per is not None:
                states[metric.field] = states[metric.per] = 0.0
        self.states.assign(wp.array(states, dtype=self.task.state, device=self.device))
        return values_by_name


class ParamArrays:
    """Device array of the parameters of all terms of a task; values can change while captured CUDA graphs read them."""

    def __init__(self, params: TaskParams, device: wp.DeviceLike) -> None:
        """Copy a task's initial parameters to the device; params: names and values; device: Warp device."""
        self.params = params
        self._numbers = list(params.values)  # `values` before their conversion to float32
        self.values = wp.array(params.values, dtype=float, device=device)
        self.changed = wp.full(len(params.values), math.inf, dtype=float, device=device)
        """Numbers changed by `set`, (len(values),); infinity elsewhere."""

    @locked
    def set(self, name: str, value: float) -> None:
        """Change a term's parameter, given by its dotted name, on the device: in `values`, which the kernels read.

        `changed` holds the same numbers, and is saved with the environment's state.
        Raises InputError: there is none, or the term refuses the value in a configuration too.
        """
        i = self.params.index(name)
        value = self._numbers[i] = self.params.checked([*self._numbers[:i], value, *self._numbers[i + 1 :]], i)
        for array in (self.values, self.changed):
            array[i : i + 1].fill_(value)

    def restore(self) -> None:
        """Reset all parameters to `params.values` except those that `set` changed. Waits for the device."""
        self._numbers = self.restored(self.changed.numpy())
        self.values.assign(np.array(self._numbers, dtype=np.float32))

    def restored(self, changed: np.ndarray) -> list[float]:
        """Return all parameters, with those of `changed` that are finite. Raises InputError: a term refuses one."""
        decimals = [float(str(value)) for value in changed]  # such as 0.1 for the float32 0.100000001
        pairs = zip(self.params.values, decimals, strict=True)
        numbers = [value if math.isinf(change) else change for value, change in pairs]
        for slot in (slot for slots in self.params.slots.values() for slot in slots):
            slot.term.with_flat_numbers(numbers[slot.first : slot.stop])
        return numbers


def _finite(states: np.ndarray, field: str) -> np.ndarray:
    """Return a field of task states, (num_envs,) float64, with 0 in place of values that are not finite."""
    return np.nan_to_num(states[field].astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)


def kernels_of(task: TaskCfg) -> dict[str, Kernel]:
    """Return a task's kernels by name, built by `make_<name>_kernel` and cached, without compiling them.

    Names: step, reset, set_command, observe, event. Tasks that differ only in numbers share kernels, since numbers are
    an argument: a variant of a task needs no compilation.
    """
    slots = task.params.slots
    compiled = {section: tuple(slot.compiled for slot in section_slots) for section, section_slots in slots.items()}
    ends = tuple(compiled[section] for section in ("advance", "curriculum", "rewards", "terminations"))
    begins = (task.reset.func, task.settings_type, task.level_type, task.command.resample_due, task.command.resample)
    return {
        "step": _kernel(make_step_kernel, task, task.state, ends, task.reward_floor, task.command.resample_due),
        "reset": _kernel(make_reset_kernel, task, task.state, begins),
        "set_command": _kernel(make_set_command_kernel, task, task.state, task.command.set),
        "observe": _kernel(
            make_observe_kernel, task, task.state, tuple(compiled[f"observations.{group}"] for group in task.groups)
        ),
        "event": _kernel(make_event_kernel, slots["events"], compiled["events"]),
    }


def _kernel(make: Callable[[T], Kernel], source: T, *key_parts: object) -> Kernel:
    """Return the kernel that `make` builds from `source`, built once and cached.

    Key: `make` and key_parts, all parts of source that the kernel depends on, with the code of their functions.
    """
    if (key := (make, *key_parts, content_hash(*key_parts))) not in _KERNELS:
        _KERNELS[key] = make(source)
    return _KERNELS[key]

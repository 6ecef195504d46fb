"""Search for terms of a user that crash the process, as by reading outside an array: each runs alone, with checks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from multiprocessing import get_context
from signal import Signals
from typing import Any

from jumper_warp.kernels.mdp.factory import FAST
from jumper_warp.tasks.cfg import ObservationsCfg, TaskCfg
from jumper_warp.tasks.functions import is_own

STEPS = 30  # Policy steps for which a term runs
WORLDS = 2
REST = "advance, curriculum, reset and command"


def check_terms(task: TaskCfg) -> Iterator[tuple[str, str]]:
    """Run each of a user's terms alone; yield its name, such as `rewards.my_term`, and how it failed, "" if it did not.

    Every term runs in a process of its own, on a CPU, for 30 policy steps with random actions. Warp's debug mode stops
    it at an index outside an array, with a line on standard error. The parts of the task that every environment needs
    run first. The task must be importable by name, as for `pickle`.
    """
    for name, alone in own_terms_alone(task).items():
        process = get_context("spawn").Process(target=run_checked, args=(alone,))
        process.start()
        process.join()
        code = process.exitcode or 0
        yield name, f"killed by {Signals(-code).name}" if code < 0 else f"exit status {code}" if code else ""


def own_terms_alone(task: TaskCfg) -> dict[str, TaskCfg]:
    """Return copies of a task with one of the user's optional terms each, and without any under the name REST."""
    sections = {f"observations.{group}": getattr(task.observations, group) for group in task.groups}
    sections |= {name: getattr(task, name) for name in ("rewards", "terminations", "events")}

    def keeping(own: object) -> TaskCfg:
        """Return the task with the project's terms, and of the user's terms only `own`, which a crash then names."""
        kept = {name: tuple(t for t in terms if t is own or not is_own(t.func)) for name, terms in sections.items()}
        observations = ObservationsCfg(kept.pop("observations.actor"), kept.pop("observations.critic"))
        return replace(task, observations=observations, **kept)

    own = {f"{name}.{term.name}": term for name, terms in sections.items() for term in terms if is_own(term.func)}
    return {REST: keeping(None), **{name: keeping(term) for name, term in own.items()}}


def run_checked(task: TaskCfg) -> None:
    """Step an environment of a task whose kernels stop the process at an index outside an array."""
    import torch

    from jumper_warp.envs.env import Env

    modes: dict[str, Any] = FAST
    modes["mode"] = "debug"
    env = Env(task, WORLDS, device="cpu")
    env.reset()
    for action in 2.0 * torch.rand(STEPS, WORLDS, 12) - 1.0:
        env.step(action)

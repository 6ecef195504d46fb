"""Watching of a run without `--watch`: its newest checkpoint is simulated, and replaced when the training saves one."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

import numpy as np

from jumper_warp.live.buffer import WorldBuffer
from jumper_warp.live.feed import Feed, Steps, Viewer
from jumper_warp.live.training import setup_of
from jumper_warp.policies.policy import Policy
from jumper_warp.recipe import Recipe
from jumper_warp.rl.checkpoint import latest_checkpoint, newest_name
from jumper_warp.rl.metrics_file import last_metrics
from jumper_warp.rl.run_names import CHECKPOINTS
from jumper_warp.training import make_env
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import parse_json

WORLDS = 16  # Number of simulated robots
STEPS = 6  # Policy steps between two messages to the viewer


def watch_checkpoints(
    run: Path, device: str, modules: Iterable[ModuleType] = (), seconds: float | None = None, viewer: Viewer = "rerun"
) -> None:
    """Simulate the newest checkpoint of a run's folder in real time in a viewer, without exploration noise.

    Worlds have curriculum levels of the checkpoint's worlds. modules: the user's task modules. seconds: time after
    which to end (default: with the viewer's process).
    Raises CheckpointError or TaskError: the run has no usable checkpoint. InputError: the viewer's process failed.
    """
    path, state, _, _ = latest_checkpoint(run / CHECKPOINTS)
    recipe = Recipe.from_json(parse_json(state["config"], "config"), list(modules) or None)
    env = make_env(recipe, WORLDS, recipe.train.seed, device)
    env.reset()
    levels = state["env"]["env.level"].numpy()
    env.episodes.level.assign(np.sort(levels)[np.linspace(0, len(levels) - 1, WORLDS).astype(int)])
    env.reset(worlds=range(WORLDS))
    buffer = WorldBuffer(env, STEPS)
    env.step_hooks.append(buffer.record)
    feed = Feed(setup_of(buffer, [run], float(last_metrics(run).get("Perf/elapsed_s", 0.0)), viewer=viewer))
    begin = time.monotonic()
    policy: Policy | None = None
    steps = 0
    while not feed.broken and (seconds is None or steps * env.step_dt < seconds):
        if policy is None or newest_name(path.parent) != path.name:
            path, state, _, _ = latest_checkpoint(path.parent)
            policy = Policy.load(path).to(env.device)
            print(f"watch: simulating {path}", file=sys.stderr, flush=True)
        for _ in range(STEPS):
            env.step(policy.act(env.obs))
        steps += STEPS
        words = buffer.fetch()
        if words is not None:
            feed.put(Steps(0, buffer.number, state["iteration"], words))
        time.sleep(max(0.0, begin + steps * env.step_dt - time.monotonic()))
    feed.close()
    if status := feed.process.wait():
        raise InputError(f"the viewer's process ended with status {status}")

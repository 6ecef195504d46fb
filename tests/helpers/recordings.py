"""Recordings of jumps with random actions."""

import numpy as np

from jump_helpers import make_env, random_actions
from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.log import run_evaluation
from jumper_warp.evaluation.recorder import EnvRecorder


def record_jumps(heights, steps, worlds, on_step=lambda env: None, **settings):
    """Return a recorder of some worlds that were commanded to jump to heights [m], for a number of policy steps.

    settings: of the environment.
    """
    env = make_env(len(heights), **settings)
    log = JumpLog(np.array(heights), env.task.termination_names)
    recorder = EnvRecorder(env, log, worlds, notes={"task": "vertical-jump"})
    actions = iter(random_actions(len(heights), steps))

    def record():
        recorder()
        on_step(env)

    settings = {"on_begin": recorder.begin, "on_step": record, "stop": False}
    run_evaluation(lambda obs: next(actions), env, log, seconds=steps / 60, **settings)
    return recorder

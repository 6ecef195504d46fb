"""How high the open-loop jump takes each robot."""

import numpy as np
import pytest
import torch
from jump_helpers import make_env
from randomization_helpers import read

from experiments.vertical_jump_sweep import OPEN_LOOP_APEX, for_sweep
from jumper_warp.evaluation.jumps import jump_commands
from jumper_warp.evaluation.limits import open_loop_limits
from jumper_warp.policies.restore import Conditions
from jumper_warp.registry import make_task

pytestmark = pytest.mark.usefixtures("one_thread")


def begun(conditions, worlds):
    """Return an environment that has begun no episode yet, and its state."""
    task = conditions.applied(for_sweep(make_task("vertical-jump")))
    env = make_env(worlds, task=task, randomize=conditions.draws, auto_reset=False)
    return env, env.state_dict()


@pytest.mark.parametrize(("gains", "apex"), [(None, OPEN_LOOP_APEX), ((0.6, 1.0), 0.757), ((0.6, 0.6), 0.922)])
def test_limit_is_the_apex_of_the_open_loop_jump(gains, apex):
    """Those of weak motors from `Simulation` alone, at every physics step; here the base is seen at 60 Hz."""
    assert open_loop_limits(*begun(Conditions(gains=gains), 2)) == pytest.approx([apex] * 2, abs=0.002)


def test_limits_are_of_the_very_robots_that_jumped_before():
    env, fresh = begun(Conditions(randomize=True), 8)
    command = jump_commands(np.tile([0.0, 0.0, 0.8], (8, 1)), 0.5, env.step_dt)
    env.evaluation_reset(command)
    drawn, skill = read(env), env.skills[0]
    for _ in range(30):
        env.step(torch.zeros((8, 12)))
    numbers = skill.numbers.numpy().copy()
    limits = open_loop_limits(env, fresh)
    found = read(env)
    for name in drawn:
        if name in ("force", "torque"):
            assert not found[name].any()
        else:
            np.testing.assert_array_equal(found[name], drawn[name], err_msg=name)
    np.testing.assert_array_equal(skill.numbers.numpy(), numbers)
    assert 0.75 < limits.min() < limits.max() - 0.05 < 1.3
    np.testing.assert_array_equal(open_loop_limits(env, fresh), limits)

"""Apex of the open-loop jump of each robot."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from jump_helpers import make_env
from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.evaluation.jumps import jump_commands
from jumper_warp.evaluation.limits import open_loop_limits
from jumper_warp.registry import make_task
from jumper_warp.robot.motors import vertical_jump_filter
from jumper_warp.sim.apex import EXTEND, HOLD, RAMP
from jumper_warp.sim.simulation import Simulation
from jumper_warp.tasks.jump.evaluation import with_jump_terminations
from landing_helpers import OPEN_LOOP_APEX
from leg_springs import STAND, transversal_command
from randomization_helpers import read

pytestmark = pytest.mark.usefixtures("one_thread")


def initial_env(conditions, worlds):
    """Return an environment without a begun episode under some conditions, and its `state_dict`."""
    task = conditions.applied(with_jump_terminations(make_task("vertical-jump")))
    env = make_env(worlds, task=task, randomize=conditions.sets_parameters, auto_reset=False)
    return env, env.state_dict()


def simulated_apex(kp, kd):
    """Return the apex [m] of the open-loop jump with gains scaled by kp, kd [1], simulated without an environment."""
    motors = make_task("vertical-jump").motors
    lateral, transversal = (replace(m, kp=kp * m.kp, kd=kd * m.kd) for m in (motors.lateral, motors.transversal))
    motors = replace(motors, lateral=lateral, transversal=transversal)
    sim = Simulation(1, motors=motors, command_filter=vertical_jump_filter(), visuals=False, device="cpu")
    heights = []
    for tick in range(STAND + RAMP + HOLD + EXTEND):
        sim.target.assign((np.tile([0.0, 1.0, 1.0], 4) * transversal_command(tick, 135.0))[:, None].astype(np.float32))
        sim.step()
        heights.append(sim.joint_q()[0, 2])
    return max(heights[STAND + RAMP + HOLD :])


# 0.757 m: from an independent simulation
@pytest.mark.parametrize(("gains", "about"), [(None, OPEN_LOOP_APEX), ((0.6, 1.0), 0.757)], ids=["nominal", "weak"])
def test_open_loop_limit_equals_simulated_apex(gains, about):
    apexes = open_loop_limits(*initial_env(Conditions(gain_scale=gains), 2))
    assert apexes == pytest.approx([simulated_apex(*(gains or (1.0, 1.0)))] * 2, abs=0.002)
    assert apexes == pytest.approx([about] * 2, abs=0.005)


def test_open_loop_limits_reuse_sampled_robots_without_pushes_and_are_reproducible():
    env, fresh = initial_env(Conditions(randomize=True), 8)
    command = jump_commands(np.tile([0.0, 0.0, 0.8], (8, 1)), 0.5, env.step_dt)
    env.evaluation_reset(command)
    drawn, skill = read(env), env.skills[0]
    for _ in range(30):
        env.step(torch.zeros((8, 12)))
    numbers = skill.params.values.numpy().copy()
    limits = open_loop_limits(env, fresh)
    params = read(env)
    for name in drawn:
        if name in ("push_force", "push_torque"):
            assert not params[name].any()
        else:
            np.testing.assert_array_equal(params[name], drawn[name], err_msg=name)
    np.testing.assert_array_equal(skill.params.values.numpy(), numbers)
    assert 0.75 < limits.min() < limits.max() - 0.05 < 1.3  # [m]
    np.testing.assert_array_equal(open_loop_limits(env, fresh), limits)

"""Differentiable rewards: values against the environment's terms, gradients by actions against differences."""

import numpy as np
import pytest
import torch

from columns import Z
from jumper_warp.diff.closed_loop import ClosedLoop
from jumper_warp.diff.differentiable_env import DifferentiableEnv, clip_norm
from jumper_warp.diff.smooth_rewards import SMOOTH, make_context
from jumper_warp.envs.env import Env
from jumper_warp.policies.runs import open_policy
from jumper_warp.registry import make_task
from jumper_warp.tasks.jump.cfg import StartProbability
from jumper_warp.trajectory.gauss_newton import Network

TASK = make_task("vertical-jump").on_level_ground()


def height_reward(term, error):
    """Return a term's weighted reward of height errors [m]: Gaussian fine + 3 exponential sharp + Gaussian wide."""
    fine, sharp, wide = (term.numbers[name] for name in ("std_fine", "scale_sharp", "std_wide"))
    kernels = np.exp(-((error / fine) ** 2)) + 3.0 * np.exp(-np.abs(error) / sharp) + np.exp(-((error / wide) ** 2))
    return term.numbers["weight"] * kernels


def test_smooth_rewards_match_the_environments_terms():
    """Thirty steps of 24 worlds pass through all phases of a jump, and every smooth term is nonzero once.

    At the apex the environment rewards the highest policy step, the smooth term the ballistic apex."""
    env = Env(TASK, 24, seed=2, randomize=False, noise=False, device="cpu")
    env.reset()
    loop, network, paid = ClosedLoop(env), Network(open_policy("vertical_jump")), set()
    old = loop.state()
    for _ in range(30):
        env.step(network.act(env.obs) + 0.1 * torch.sin(torch.arange(12.0) + env.obs[:, :1]))
        state, running, arrays = loop.state(), env.done == 0.0, env.task_arrays()
        context = make_context(loop, state, old, arrays)
        for term, values in zip(TASK.rewards, env.skills[0].term_value.numpy(), strict=True):
            if term.func.key not in SMOOTH:
                continue
            time = env.step_dt if term.options["scale_by_dt"] else 1.0
            smooth = term.numbers["weight"] * time * SMOOTH[term.func.key](context, term.numbers)
            if term.name == "jump_height":
                at_apex = (running.numpy() == 1) & (arrays["at_apex"] == 1)
                base, goal = context.motion, arrays["goal"][:, Z]
                ballistic = (base.pos[:, Z] + base.lin_vel[:, Z] ** 2 / (2.0 * TASK.gravity)).numpy()
                for reward, height in ((smooth.numpy(), ballistic), (values, arrays["max_height"])):
                    np.testing.assert_allclose(reward[at_apex], height_reward(term, height - goal)[at_apex], rtol=2e-4)
                assert not smooth.numpy()[~at_apex & (running.numpy() == 1)].any()
                # the highest policy step is the one before or after the apex
                highest = torch.maximum(context.prev_motion.pos[:, Z], base.pos[:, Z]).numpy()
                np.testing.assert_allclose(arrays["max_height"][at_apex], highest[at_apex], rtol=0.0, atol=1.0e-6)
                # moving legs change the base's acceleration; its change of velocity in this step bounds the error
                speed_change = (context.prev_motion.lin_vel - base.lin_vel)[:, 2].numpy()
                assert (np.abs(ballistic - highest) < speed_change**2 / (2.0 * TASK.gravity))[at_apex].all()
                paid |= {term.name} if at_apex.sum() else set()
                continue
            expected = torch.as_tensor(values)[running]
            atol = 1.0e-5 + 1.0e-4 * float(expected.abs().max())
            torch.testing.assert_close(smooth[running].float(), expected, rtol=0.0, atol=atol, msg=term.name)
            paid |= {term.name} if float(expected.abs().max()) > 0.0 else set()
        old = state
    rough = {term.name for term in TASK.rewards if term.func.key not in SMOOTH}
    assert paid == {term.name for term in TASK.rewards} - rough
    assert rough == {
        "paws_down", "soft_impact", "stance_impact", "ground_force", "action_clip", "force_ripple",
    }  # fmt: skip


def test_differentiable_env_matches_values_and_central_differences():
    """Rewards and observations equal those of a plain environment; gradients by actions equal differences.

    Three robots in flight take three steps; in single precision differences need 0.01 of an action. Differences are of
    the terms in SMOOTH, as the gradient takes the others as constant.
    """
    flights = type(TASK.reset.settings)(start_probability=StartProbability(in_flight=1.0), flight_time=(0.05, 0.3))
    task = TASK.__class__(**{**vars_of(TASK), "reset": TASK.reset.__class__(TASK.reset.func, flights)})
    envs = [Env(task, 3, seed=5, randomize=False, noise=False, device="cpu") for _ in range(2)]
    for env in envs:
        env.reset()
    start, by_gradients = envs[1].state_dict(), DifferentiableEnv(envs[1])
    actions = 0.3 * torch.sin(torch.arange(108.0)).view(3, 3, 12)  # (steps, worlds, 12)

    def rewards(actions):  # (3 worlds,) sum over steps, with gradients
        envs[1].load_state_dict(start)
        by_gradients.begin_window()
        total = 0.0
        for action in actions:
            by_gradients.observe()
            total = total + by_gradients.step_with_gradient(action)
        return total

    variable = actions.clone().requires_grad_()
    total = rewards(variable)
    expected = sum(envs[0].step(action).reward.clone() for action in actions)  # of a plain environment
    torch.testing.assert_close(total.detach(), expected, rtol=0.0, atol=0.0)
    torch.testing.assert_close(envs[1].obs, envs[0].obs, rtol=0.0, atol=0.0)
    gradient = torch.autograd.grad(total.sum(), variable)[0]
    rough = [i for i, term in enumerate(task.rewards) if term.func.key not in SMOOTH]

    def smooth_total(actions):  # sum of the smooth terms' values over worlds and steps
        envs[1].load_state_dict(start)
        total = 0.0
        for action in actions:
            envs[1].step(action)
            values = envs[1].skills[0].term_value.numpy().copy()
            values[rough] = 0.0
            total = total + values.sum()
        return total

    for entry in ((0, 0, 1), (0, 2, 5), (1, 1, 0)):  # (step, world, motor)
        change = torch.zeros_like(actions)
        change[entry] = 0.01
        difference = (smooth_total(actions + change) - smooth_total(actions - change)) / 0.02
        assert gradient[entry].item() == pytest.approx(difference, rel=0.03, abs=2.0e-3)


def vars_of(task):
    """Return the fields of a task by name."""
    return {name: getattr(task, name) for name in task.__dataclass_fields__}


def test_clip_norm_clips_each_world_and_zeroes_non_finite_gradients():
    grad = torch.tensor([[3.0, 0.3, np.nan], [4.0, 0.4, 1.0]])
    expected = torch.tensor([[0.6, 0.3, 0.0], [0.8, 0.4, 0.0]])
    torch.testing.assert_close(clip_norm(1.0)(grad), expected)

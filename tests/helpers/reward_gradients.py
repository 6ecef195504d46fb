"""Compare gradients of returns, through rewards and physics with contact, with differences in double precision.

    python -m tests.helpers.reward_gradients vertical_jump horizontal_jump walking attitude

Robots start a window of policy steps anywhere in episodes of their policy. The gradient of the window's return by all
actions is compared with central differences along random directions, of a simulation in double precision: the cosine
over the directions, one for each robot. Windows are counted by contact, and by branches that change between the two
ends of a difference: paws that touch or leave the ground, pressed stops.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from jumper_warp.diff.rollout import Rollout
from jumper_warp.envs.env import Env
from jumper_warp.envs.gradients import LoopState, origin_velocity
from jumper_warp.policies.policy import Policy

FRACTION = 0.97  # Of the policy's actions, so that none is at its limit, where the gradient is one-sided


@dataclass
class Window:
    """A window of policy steps of all robots."""

    start: LoopState  # State at its beginning
    actions: torch.Tensor  # (steps, num_envs, 12)
    arrays: list[dict[str, wp.array]]  # Of each step, see `EnvGradients.arrays`
    running: torch.Tensor  # (steps, num_envs) Whether the episode has not ended before the step
    gradient: torch.Tensor  # (steps, num_envs, 12) Of the return by the actions


def record(env: Env, policy: Policy, steps: int) -> Window:
    """Step the environment through a window, and differentiate each robot's return."""
    actions = torch.zeros(steps, env.num_envs, 12, device=env.device)
    changes = torch.zeros_like(actions, requires_grad=True)
    arrays = []
    running = [torch.ones(env.num_envs, dtype=torch.bool, device=env.device)]
    total = torch.zeros(env.num_envs, device=env.device)
    with env.gradients() as gradients:
        start = gradients.state
        for i in range(steps):
            actions[i] = FRACTION * policy.act(env.obs)
            step = env.step(actions[i] + changes[i])
            total = total + torch.where(running[-1], step.reward, 0.0)
            arrays.append(gradients.arrays)
            running.append(running[-1] & ~step.terminated & ~step.truncated)
        (gradient,) = torch.autograd.grad(total.sum(), changes)
    return Window(start, actions, arrays, torch.stack(running[:-1]), gradient)


def double_rollout(env: Env) -> Rollout:
    """Return a rollout in double precision with the parameters of an environment's robots."""
    robots = env.snapshot()
    task = robots.tasks[0]
    rollout = Rollout(
        robots.model, task.motors, task.command_filter, double=True, dt=robots.dt, substeps=robots.substeps
    )
    for name, tensor in robots.parameters.items():
        wp.to_torch(rollout.parameters[name]).copy_(tensor)
    return rollout


def simulated_returns(env: Env, rollout: Rollout, window: Window) -> Callable[[torch.Tensor], tuple]:
    """Return a function of actions to the returns (num_envs,), contacts and pressed stops in double precision.

    Contact timers, phases and other events are those of the window.
    """
    gradients = env.gradients()
    n = env.num_envs
    lateral, transversal = np.deg2rad(env.task.action_scale)
    scale = np.tile([lateral, transversal, transversal], 4)[:, None]
    default = env.robot.default_angle.numpy()[:, None]
    start = {name: rollout.array(getattr(window.start, name).cpu()) for name in ("q", "qd", "initial_target")}
    start["impulse"] = rollout.vectors(window.start.impulse.cpu())

    def simulate(actions: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Simulate the window with these actions."""
        targets = actions.cpu().numpy().astype(np.float64).transpose(0, 2, 1) * scale + default
        jump = rollout.run(targets, **start)
        q, qd, torque, filtered = (getattr(jump, name).numpy() for name in ("q", "qd", "torque", "filtered_target"))
        force = jump.impulse.numpy() / rollout.dt
        total = np.zeros(n)
        substeps = rollout.substeps
        last_action, earlier = (getattr(window.start, name).cpu().numpy() for name in ("action", "prev_action"))
        for i, arrays in enumerate(window.arrays):
            values = {
                "torque": torque[(i + 1) * substeps - 1],
                "prev_torque": torque[i * substeps - 1] if i else window.start.torque.cpu().numpy(),
                "paw_force": force[(i + 1) * substeps - 1],
                "peak_force": np.linalg.norm(force[i * substeps : (i + 1) * substeps], axis=-1).max(0),
                "action": actions[i].cpu().numpy().T, "prev_action": last_action, "prev_prev_action": earlier,
                "target": targets[i], "filtered_target": filtered[i], "prev_rate": qd[i][6:],
            }  # fmt: skip
            earlier, last_action = last_action, values["action"]
            moved = {name: wp.clone(array) for name, array in arrays.items()}
            for name, value in values.items():
                wp.to_torch(moved[name], requires_grad=False).copy_(torch.as_tensor(np.ascontiguousarray(value)))
            for name, value, base in (("joint_q", q[i + 1], 7), ("joint_qd", qd[i + 1], 6)):
                _write_compact(
                    wp.to_torch(moved[name], requires_grad=False).view(n, -1), torch.as_tensor(value.T), base
                )
            com = wp.to_torch(arrays["body_com"]).view(n, -1, 3)[:, 0].double().cpu()
            velocity = origin_velocity(torch.as_tensor(q[i]), torch.as_tensor(qd[i]), com).T
            wp.to_torch(moved["prev_lin_vel"], requires_grad=False).copy_(velocity)
            terms = wp.to_torch(gradients.evaluate(moved)[0]).double().cpu()
            counted = window.running[i].cpu().numpy()
            reward = terms.sum(0).numpy()
            floor = env.task.reward_floor
            total += counted * (reward if floor is None else np.maximum(reward, floor))
        return total, np.linalg.norm(force, axis=-1) > 0.0, jump.pressed.numpy()

    return simulate


def _write_compact(joints: torch.Tensor, values: torch.Tensor, base: int) -> None:
    """Write coordinates or rates of base and motors, (num_envs, base + 12), into Newton's joint array in place."""
    joints[:, :base] = values[:, :base]
    legs = joints[:, base : base + 20].unflatten(1, (4, 5))
    legs[..., [0, 1, 3]] = values[:, base:].unflatten(1, (4, 3)).to(joints.dtype)


def compare(
    policy: Policy, num_envs: int = 64, steps: int = 10, directions: int = 8, change: float = 1.0e-4
) -> dict[str, np.ndarray]:
    """Return, for each window: cosine of gradient and differences, contact, changed branches; (num_envs,) each.

    change: standard deviation [1] of the changes of the actions.
    """
    task = policy.recipe().task.on_level_ground()
    env = Env(task, num_envs, device="cpu", randomize=False, noise=False)
    env.reset()
    with torch.no_grad():
        for _ in range(60):
            env.step(FRACTION * policy.act(env.obs) + 0.05 * torch.randn(num_envs, 12))
    window = record(env, policy, steps)
    simulate = simulated_returns(env, double_rollout(env), window)
    generator = torch.Generator().manual_seed(0)
    pairs = []
    changed, touched = np.zeros((2, num_envs), dtype=bool)
    for _ in range(directions):
        direction = change * torch.randn(window.actions.shape, generator=generator)
        (high, *above), (low, *below) = (simulate(window.actions + sign * direction) for sign in (1.0, -1.0))
        pairs.append(((window.gradient * direction).sum((0, 2)).double().numpy(), 0.5 * (high - low)))
        changed |= np.any([(a != b).any((0, 1)) for a, b in zip(above, below, strict=True)], axis=0)
        touched |= above[0].any((0, 1))
    found, expected = np.array(pairs).transpose(1, 0, 2)
    norms = np.linalg.norm(found, axis=0) * np.linalg.norm(expected, axis=0)
    return {"cosine": (found * expected).sum(0) / np.maximum(norms, 1.0e-30), "contact": touched, "changed": changed}


if __name__ == "__main__":
    for name in sys.argv[1:]:
        windows = compare(Policy.load(name))
        cosine = windows["cosine"]
        branches = windows["changed"][cosine < 0.99].mean() if (cosine < 0.99).any() else 1.0
        print(f"{name}: {(cosine >= 0.99).mean():.0%} of windows with a cosine of at least 0.99, median "
              f"{np.median(cosine):.3f}, {windows['contact'].mean():.0%} with contact; of the others {branches:.0%} "
              "with a changed branch")  # fmt: skip

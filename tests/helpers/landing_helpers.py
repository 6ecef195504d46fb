"""A policy of any task that holds the default pose, and the open-loop jump and its apex."""

import itertools

import torch

from jumper_warp.policies.policy import Policy
from jumper_warp.policies.spec import make_interface
from jumper_warp.registry import make_task
from jumper_warp.tasks.interface import interface
from jumper_warp.tasks.saving import task_to_json

OPEN_LOOP_APEX = 1.0748
"""[m] Apex of the nominal robot's open-loop jump at 18 N m, without latency; the paper's robot: 1.075 m."""


def still_policy(name):
    """Return a policy of a task, with zero weights: its action is the default pose."""
    task = make_task(name)
    face = make_interface(interface(task), policy_dt=1.0 / 60.0, physics_dt=1.0 / 480.0, hidden=(4,))
    sizes = face.sizes
    layers = [(torch.zeros(out, size), torch.zeros(out)) for size, out in itertools.pairwise(sizes)]
    return Policy(layers, torch.zeros(sizes[0]), torch.ones(sizes[0]), face, {"env": {"task": task_to_json(task)}})


class OpenLoopPolicy:
    """Policy that from policy step `begin` on squats for 60 steps and then extends the legs for 20 steps."""

    def __init__(self, begin=31):
        self.begin, self.step = begin, 0

    def act(self, obs):  # actions (num_envs, 12), whatever the observations (num_envs, n)
        elapsed = self.step - self.begin
        self.step += 1
        level = 0.0 if elapsed < 0 else min(elapsed / 25, 1.0) if elapsed < 60 else -1.0 if elapsed < 80 else 0.0
        return torch.tensor([0.0, level, level] * 4).repeat(len(obs), 1)

"""A policy of any task that holds the default pose."""

import itertools

import torch

from jumper_warp.envs.env import plain
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.spec import interface_of_task
from jumper_warp.registry import make_task


def still_policy(name):
    task = make_task(name)
    face = interface_of_task(task, policy_dt=1.0 / 60.0, physics_dt=1.0 / 480.0, hidden=(4,))
    sizes = face.sizes
    layers = [(torch.zeros(out, size), torch.zeros(out)) for size, out in itertools.pairwise(sizes)]
    return Policy(layers, torch.zeros(sizes[0]), torch.ones(sizes[0]), face, {"env": {"task": plain(task)}})

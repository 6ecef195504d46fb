"""Warm start of a training from a shipped policy."""

import dataclasses

import pytest
import torch

from jumper_warp.policies.policy import Policy
from jumper_warp.policies.warm_start import actor_init_from_policy, task_symmetries
from jumper_warp.recipe import Recipe
from jumper_warp.registry import TASKS, make_task
from jumper_warp.rl.actor_init import apply_actor_init, make_actor_init
from jumper_warp.rl.networks import ActorCritic
from jumper_warp.robot.overlay import load_overlay
from jumper_warp.training import train
from jumper_warp.utils.errors import InputError

WIDE = {"symmetry": "off", "hidden": (512, 256, 256)}  # the plain form of a symmetric actor has twice the widths


@pytest.mark.parametrize(
    ("name", "task", "change"),
    [
        ("horizontal_jump", "horizontal-jump-mars", {}),
        ("horizontal_jump", "horizontal-jump-mars", WIDE),
        ("vertical_jump", "vertical-jump-mars", WIDE),
        ("walking", "velocity-rough", WIDE),
    ],
)
def test_initialised_actor_acts_as_the_shipped_policy(name, task, change):
    policy, cfg, task = Policy.load(name), dataclasses.replace(TASKS[task].ppo, **change), make_task(task)
    symmetries = task_symmetries(task, cfg.symmetry)
    assert len(symmetries) == (name == "horizontal_jump" and not change)
    torch.manual_seed(0)
    sizes = policy.interface.sizes
    model = ActorCritic(sizes[0], sizes[-1], cfg.hidden, cfg.activation, cfg.init_std, symmetries=symmetries)
    apply_actor_init(actor_init_from_policy(name, task, cfg), model, samples=1000)
    obs = policy.mean + 2.0 * policy.std * torch.randn(500, sizes[0])
    expected = policy.act(obs)
    assert expected.std() > 0.1
    torch.testing.assert_close(model.act(obs), expected, atol=1e-5, rtol=0.0)


@pytest.mark.parametrize(
    ("name", "task", "change", "message"),
    [
        ("horizontal_jump", "horizontal-jump", {"symmetry": "off"},
         "hidden layers 512, 256, 256, the settings 256, 128, 128: pass --ppo.hidden 512 256 256"),
        ("vertical_jump", "horizontal-jump", {}, r"observation \d+: the policy has \w+, the task \w+"),
        ("horizontal_jump", "horizontal-jump-sighted", {}, r"observation 147: the policy has none, the task block_\w+"),
    ],
)  # fmt: skip
def test_refuses_a_policy_that_does_not_fit_in_one_line(name, task, change, message):
    with pytest.raises(InputError, match=f"init_policy: .*{message}") as caught:
        actor_init_from_policy(name, make_task(task), dataclasses.replace(TASKS[task].ppo, **change))
    assert "\n" not in str(caught.value)


def test_the_policy_is_compared_with_the_robot_of_the_training(tmp_path):
    recipe = Recipe.of("vertical-jump", load_overlay("small_direct_drive"))
    cfg = dataclasses.replace(
        recipe.train, init_policy="vertical_jump", num_envs=8, max_iterations=1, device="cpu", log_root=tmp_path
    )
    with pytest.raises(InputError, match=r"default angle \[rad\] of \w+: the policy has"):
        train(dataclasses.replace(recipe, train=cfg))


def test_symmetric_training_starts_from_the_projection_of_a_nearly_symmetric_policy():
    policy, task, cfg = Policy.load("horizontal_jump"), make_task("horizontal-jump"), TASKS["horizontal-jump"].ppo
    symmetries, generator = task_symmetries(task, cfg.symmetry), torch.Generator().manual_seed(2)
    layers = [(w + 3.0e-4 * torch.randn(w.shape, generator=generator), bias) for w, bias in policy.layers]
    near = Policy(layers, policy.mean, policy.std, policy.interface, policy.config)
    start = make_actor_init(layers, policy.mean, policy.std, policy.interface.activation, cfg, symmetries)
    model = ActorCritic(147, 12, cfg.hidden, cfg.activation, cfg.init_std, symmetries=symmetries)
    apply_actor_init(start, model, samples=1000)
    obs = policy.mean + policy.std * torch.randn(500, 147, generator=generator)
    assert start.change == "made mirror-symmetric"
    assert 0.0 < (model.act(obs) - near.act(obs)).abs().mean() < 0.01

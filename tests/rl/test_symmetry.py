import dataclasses
import json

import numpy as np
import pytest
import torch

from jumper_warp.policies.policy import Policy
from jumper_warp.policies.warm_start import task_symmetries
from jumper_warp.registry import make_task
from jumper_warp.rl.cfg import PpoCfg, TrainCfg
from jumper_warp.rl.checkpoint import save_checkpoint
from jumper_warp.rl.mirror import expand_layers, mirror_map
from jumper_warp.rl.networks import ActorCritic
from jumper_warp.rl.torch.ppo import Ppo
from jumper_warp.tasks.interface import interface
from jumper_warp.tasks.mirror import mirror_image
from jumper_warp.tasks.saving import task_to_json
from jumper_warp.utils.errors import InputError
from toy_task import PushTask

OBS, ACTION = (mirror_image(make_task("velocity-flat"), name) for name in ("observation", "action"))
WALKING = task_symmetries(make_task("velocity-flat"), "actor")
JUMPING = task_symmetries(make_task("horizontal-jump"), "both")
NUM_OBS = len(OBS.order)
CFG = PpoCfg(num_steps=8, epochs=2, minibatches=2, hidden=(16, 9), symmetry="actor")


def mirrored(x, mirror):
    """Return the mirror image of x (..., n) by a task's mirror map (order and signs as NumPy arrays)."""
    return torch.from_numpy(mirror.signs) * x[..., torch.from_numpy(mirror.order)]


def walker(hidden=(32, 24), symmetries=WALKING):
    """Return a symmetric `ActorCritic`, by default of the walking task, with actions as large as its inputs."""
    torch.manual_seed(3)
    model = ActorCritic(len(symmetries[0].obs.order), 12, hidden, symmetries=symmetries)
    with torch.no_grad():
        model.actor[-1].weight.mul_(100.0)
        model.actor[-1].bias.normal_()
    return model


def test_mirrored_observation_gives_the_mirrored_action():
    model, x = walker(), torch.randn(64, NUM_OBS)
    torch.testing.assert_close(model.mean(mirrored(x, OBS)), mirrored(model.mean(x), ACTION), atol=1e-5, rtol=1e-5)
    assert (model.actor(mirrored(x, OBS)) - mirrored(model.actor(x), ACTION)).abs().max() > 0.1  # f alone is not


def test_both_mirrored_observations_give_the_mirrored_actions():
    model, x = walker(symmetries=JUMPING), torch.randn(64, len(JUMPING[0].obs.order))
    left_right, front_back = JUMPING
    for obs, action in (left_right, front_back):
        torch.testing.assert_close(model.mean(obs.apply(x)), action.apply(model.mean(x)), atol=1e-5, rtol=1e-5)
    assert (model.mean(left_right.obs.apply(x)) - front_back.action.apply(model.mean(x))).abs().max() > 0.1


@pytest.mark.parametrize("symmetries", [WALKING, JUMPING], ids=["left-right", "both"])
@pytest.mark.parametrize("hidden", [(), (16,), (32, 24)])
def test_expanded_plain_network_has_the_same_output(hidden, symmetries):
    model, x = walker(hidden, symmetries), torch.randn(16, len(symmetries[0].obs.order))
    linear = [layer for layer in model.actor if isinstance(layer, torch.nn.Linear)]
    expected = model.mean(x)
    layers = expand_layers([(layer.weight, layer.bias) for layer in linear], symmetries)
    for index, (weight, bias) in enumerate(layers):
        x = torch.nn.functional.linear(x, weight, bias)
        x = torch.nn.functional.elu(x) if index < len(layers) - 1 else x
    assert [weight.shape[0] for weight, _ in layers] == [*(2 ** len(symmetries) * width for width in hidden), 12]
    torch.testing.assert_close(x, expected, atol=1e-5, rtol=1e-5)


def test_symmetrised_moments_are_those_of_samples_and_images():
    x = torch.randn(5000, NUM_OBS) * 0.7 + torch.linspace(-1.0, 1.0, NUM_OBS)
    mean, var = WALKING[0].obs.symmetrise_moments(x.mean(0), x.var(0, correction=0))
    both = torch.cat([x, mirrored(x, OBS)])
    torch.testing.assert_close(mean, both.mean(0), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(var, both.var(0, correction=0), atol=1e-5, rtol=1e-5)
    assert torch.equal(mean, mirrored(mean, OBS))
    assert torch.equal(var, var[torch.from_numpy(OBS.order)])


@pytest.mark.parametrize(
    ("order", "signs"),
    [([1, 2, 0], [1.0, 1.0, 1.0]), ([1, 0], [1.0, -1.0]), ([0, 1], [1.0, 1.0, 1.0]), ([0, 7], [1.0, 1.0])],
    ids=["cycle", "signs", "sizes", "index"],
)
def test_refuses_a_mirror_map_that_is_not_its_own_inverse(order, signs):
    with pytest.raises(InputError, match="mirror image of action is not its own inverse"):
        mirror_map(np.array(order), np.array(signs), "action")


# ---------------------------------------------------------------- training


def test_symmetric_actor_stays_symmetric_in_training():
    torch.manual_seed(0)
    ppo = Ppo(PushTask(32), CFG)
    ppo.env.reset()
    for _ in range(3):
        ppo.iterate()
    ppo.collect()
    rollout, model = ppo.rollout, ppo.model
    torch.testing.assert_close(rollout.mean, model.mean(model.features(rollout.obs[:-1])), atol=1e-5, rtol=1e-4)
    assert not model.obs_moments.mean.any() and model.obs_moments.count > 0
    obs = torch.randn(50, 2)
    assert torch.equal(model.act(-obs), -model.act(obs))
    assert model.act(obs).abs().max() > 0.0


@pytest.mark.parametrize("rows", [True, False], ids=["this version", "an earlier one"])
def test_state_with_mirror_maps_loads(rows):
    ppo, other = Ppo(PushTask(32), CFG), Ppo(PushTask(32), dataclasses.replace(CFG, symmetry="both"))
    state = ppo.state_dict()
    copies = {name: value.clone() for name, value in state["model"].items()}
    state["model"] = {name: x if rows or not name.startswith("mirror_") else x[0] for name, x in copies.items()}
    with torch.no_grad():
        ppo.model.actor[0].weight.zero_()
    ppo.load_state_dict(state)
    assert torch.equal(ppo.model.actor[0].weight, copies["actor.0.weight"]) and len(ppo.model.symmetries) == 1
    with pytest.raises(InputError, match="mirror_obs_order is for another observation, action or symmetry"):
        other.load_state_dict(state)


def test_checkpoint_of_a_symmetric_actor_opens_as_a_plain_policy(tmp_path):
    task, cfg = make_task("velocity-flat"), dataclasses.replace(CFG, hidden=(8, 6))
    model = walker(cfg.hidden)
    model.obs_moments.update(torch.randn(100, NUM_OBS))
    env = {"task": task_to_json(task), "interface": interface(task), "policy_dt_s": 1 / 60, "physics_dt_s": 1 / 480}
    config = {"env": env, "train": dataclasses.asdict(dataclasses.replace(TrainCfg(), ppo=cfg)), "commit": None}
    state = {"ppo": {"model": model.state_dict()}, "iteration": 3, "env": {}, "rng": {}}
    state["config"] = json.dumps(config, default=str)
    policy = Policy.load(save_checkpoint(tmp_path, state, None, 3))
    obs = torch.randn(30, NUM_OBS)
    torch.testing.assert_close(policy.act(obs), model.act(obs), atol=1e-5, rtol=1e-5)
    assert policy.interface.sizes == (NUM_OBS, 16, 12, 12)

"""Initialisation of a training's actor from a policy, on the task of a mass on a line."""

import dataclasses
import itertools

import pytest
import torch

from jumper_warp.policies.warm_start import task_symmetries
from jumper_warp.registry import make_task
from jumper_warp.rl.actor_init import PRIOR_ITERATIONS, apply_actor_init, make_actor_init
from jumper_warp.rl.mirror import contract_layers, expand_layers, symmetries_of
from jumper_warp.rl.networks import ActorCritic
from jumper_warp.rl.torch.ppo import Ppo
from jumper_warp.utils.errors import InputError
from toy_task import SMALL, PushTask

SYMMETRIES = symmetries_of(PushTask(1), "actor")
(SYMMETRY,) = SYMMETRIES
SYMMETRIC = dataclasses.replace(SMALL, symmetry="actor")
OBS = 3.0 * torch.randn(50, 2, generator=torch.Generator().manual_seed(1))  # position and velocity


def actor(hidden=(32, 32), symmetries=()):
    """Return an `ActorCritic` of the task with observation statistics and actions between and beyond ±1."""
    torch.manual_seed(7)
    model = ActorCritic(2, 1, hidden, symmetries=symmetries)
    with torch.no_grad():
        model.actor[-1].weight.mul_(30.0)
        for layer in model.actor[::2]:
            layer.bias.normal_()
        model.obs_moments.mean.copy_(torch.tensor([0.0, 0.0] if symmetries else [0.3, -1.0]))
        model.obs_moments.var.copy_(torch.tensor([0.4, 2.0]))
    return model


def layers_of(model):
    """Return weight (out, in) and bias (out,) of each layer of the actor."""
    return [(layer.weight.detach(), layer.bias.detach()) for layer in model.actor if isinstance(layer, torch.nn.Linear)]


def actor_init_of(model, cfg=SMALL, activation="elu"):
    """Return the `ActorInit` for training settings `cfg` from this actor as a plain network."""
    layers = expand_layers(layers_of(model), model.symmetries)
    symmetries = SYMMETRIES if cfg.symmetry == "actor" else ()
    return make_actor_init(layers, *model.obs_moments.scaling(), activation, cfg, symmetries)


# ---------------------------------------------------------------- layers of a symmetric actor


BOTH = task_symmetries(make_task("horizontal-jump"), "both")


def test_contract_inverts_expand_of_two_symmetries():
    sizes = len(BOTH[0].obs.order), 8, 4, 12
    layers = [(torch.randn(n, m), torch.randn(n)) for m, n in itertools.pairwise(sizes)]
    layers[-1][1].zero_()
    expanded = expand_layers(layers, BOTH)
    for layer, result in zip(layers, contract_layers(expanded, BOTH), strict=True):
        torch.testing.assert_close(result, layer)


@pytest.mark.parametrize("hidden", [(16,), (32, 24), (8, 6, 4)])
def test_contract_inverts_expand_of_symmetric_layers(hidden):
    layers = layers_of(actor(hidden, SYMMETRIES))
    layers[-1][1].zero_()  # the part of the bias that f(x) and N f(M x) do not cancel is 0 here
    contracted = contract_layers(expand_layers(layers, SYMMETRIES), SYMMETRIES)
    for layer, result in zip(layers, contracted, strict=True):
        torch.testing.assert_close(result, layer, atol=0.0, rtol=0.0)


@pytest.mark.parametrize("hidden", [(16,), (32, 24), (8, 6, 4)])
def test_contracted_layers_are_an_orthogonal_projection(hidden):
    exact = expand_layers(layers_of(actor(hidden, SYMMETRIES)), SYMMETRIES)
    torch.manual_seed(1)
    perturbed = [tuple(tensor + 0.1 * torch.randn_like(tensor) for tensor in layer) for layer in exact]
    assert contract_layers(perturbed, SYMMETRIES) is None
    nearest = expand_layers(contract_layers(perturbed, SYMMETRIES, tolerance=1.0), SYMMETRIES)
    other = expand_layers(layers_of(actor(hidden, SYMMETRIES)), SYMMETRIES)
    residual, tangent = (flat_difference(layers, nearest) for layers in (perturbed, other))
    assert abs(torch.dot(residual, tangent)) < 1e-4 * residual.norm() * tangent.norm()


def flat_difference(layers, others):
    """Return the differences of all weights and biases of two networks as one vector."""
    pairs = zip(itertools.chain.from_iterable(layers), itertools.chain.from_iterable(others), strict=True)
    return torch.cat([(tensor - other).flatten() for tensor, other in pairs])


# ---------------------------------------------------------------- initial actor


@pytest.mark.parametrize(
    ("policy_symmetries", "symmetry", "hidden"),
    [((), "off", (32, 32)), (SYMMETRIES, "off", (64, 64)), (SYMMETRIES, "actor", (32, 32))],
    ids=["plain policy", "symmetric policy, plain training", "symmetric policy, symmetric training"],
)
def test_initialised_actor_acts_as_the_policy(policy_symmetries, symmetry, hidden):
    model, cfg = actor(symmetries=policy_symmetries), dataclasses.replace(SMALL, symmetry=symmetry, hidden=hidden)
    ppo = Ppo(PushTask(8), cfg)
    before = {name: tensor.clone() for name, tensor in ppo.model.state_dict().items()}
    apply_actor_init(actor_init_of(model, cfg), ppo.model, samples=128)
    torch.testing.assert_close(ppo.model.act(OBS), model.act(OBS), atol=1e-5, rtol=0.0)
    assert ppo.model.obs_moments.count == PRIOR_ITERATIONS * 128
    for name, tensor in ppo.model.state_dict().items():
        assert name.startswith(("actor.", "obs_moments.")) or torch.equal(tensor, before[name]), name
    ppo.env.reset()
    ppo.collect()  # uses the new weights, although the collector was built with the old ones
    torch.testing.assert_close(ppo.rollout.mean[0].clamp(-1.0, 1.0), model.act(ppo.rollout.obs[0]), atol=1e-5, rtol=0.0)


def averaged(act, obs):
    """Return (act(x) + N act(M x)) / 2 of a policy, in the notation of `jumper_warp.rl.mirror`."""
    return 0.5 * (act(obs) + SYMMETRY.action.apply(act(SYMMETRY.obs.apply(obs))))


def test_symmetric_training_starts_from_the_mirror_averaged_policy():
    model, ppo = actor(), Ppo(PushTask(8), SYMMETRIC)
    start = actor_init_of(model, SYMMETRIC)
    apply_actor_init(start, ppo.model, samples=128)
    mean, std = model.obs_moments.scaling()
    obs = 0.5 * OBS  # within the limits of both statistics
    expected = averaged(lambda obs: model.actor((obs - mean) / std), obs).clamp(-1.0, 1.0)
    assert "averaged" in start.change and (expected - model.act(obs)).abs().max() > 0.1
    torch.testing.assert_close(ppo.model.act(obs), expected, atol=1e-5, rtol=0.0)
    mean, std = ppo.model.obs_moments.scaling()
    torch.testing.assert_close(SYMMETRY.obs.apply(mean), mean)
    torch.testing.assert_close(std[SYMMETRY.obs.order], std)


def test_nearly_symmetric_policy_is_projected_to_the_nearest_symmetric_one():
    exact = expand_layers(layers_of(actor(symmetries=SYMMETRIES)), SYMMETRIES)
    scaling = actor(symmetries=SYMMETRIES).obs_moments.scaling()
    torch.manual_seed(2)
    near, far = ([(w + noise * w.std() * torch.randn_like(w), b) for w, b in exact] for noise in (0.01, 0.5))
    start = make_actor_init(near, *scaling, "elu", SYMMETRIC, SYMMETRIES)
    assert start.change == "made mirror-symmetric"
    nearest = expand_layers(contract_layers(near, SYMMETRIES, tolerance=0.05), SYMMETRIES)
    for expected, result in zip(nearest, expand_layers(start.layers, SYMMETRIES), strict=True):
        torch.testing.assert_close(result, expected)
    with pytest.raises(InputError, match=r"pass --ppo\.hidden 64 64"):  # the average with the image keeps full widths
        make_actor_init(far, *scaling, "elu", SYMMETRIC, SYMMETRIES)

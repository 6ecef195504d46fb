import numpy as np
import pytest
import torch

from jumper_warp.registry import make_task
from jumper_warp.rl.mirror import MirrorActor
from jumper_warp.rl.networks import mlp
from jumper_warp.tasks.velocity.mirror import mirror_of, mirror_of_action
from jumper_warp.utils.errors import InputError

OBS, ACTION = mirror_of(make_task("velocity-flat"), "policy"), mirror_of_action()


def mirrored(x, mirror):
    return torch.from_numpy(mirror.signs) * x[..., torch.from_numpy(mirror.order)]


@pytest.fixture(scope="module")
def actor():
    torch.manual_seed(3)
    return MirrorActor(mlp((len(OBS.order), 32, 12), "elu", out_gain=1.0), OBS, ACTION)


def test_mirrored_observation_gives_the_mirrored_action(actor):
    obs = torch.randn(64, len(OBS.order))
    action = actor(obs)
    torch.testing.assert_close(actor(mirrored(obs, OBS)), mirrored(action, ACTION), atol=1e-6, rtol=1e-5)
    assert (actor.network(mirrored(obs, OBS)) - mirrored(actor.network(obs), ACTION)).abs().max() > 0.1


def test_no_sideways_answer_to_a_symmetric_observation(actor):
    obs = torch.randn(64, len(OBS.order))
    action = actor(0.5 * (obs + mirrored(obs, OBS)))
    torch.testing.assert_close(action[:, :3], action[:, 3:6], atol=1e-6, rtol=1e-5)


def test_symmetrised_statistics_are_those_of_both_images(actor):
    obs = torch.randn(5000, len(OBS.order)) * 0.7 + torch.linspace(-1.0, 1.0, len(OBS.order))
    mean, var = actor.symmetrised(obs.mean(0), obs.var(0, correction=0))
    both = torch.cat([obs, mirrored(obs, OBS)])
    torch.testing.assert_close(mean, both.mean(0), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(var, both.var(0, correction=0), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("hidden", [(), (16,), (32, 24)])
def test_plain_network_of_its_layers_answers_alike(hidden):
    torch.manual_seed(4)
    mirror = MirrorActor(mlp((len(OBS.order), *hidden, 12), "elu", out_gain=1.0), OBS, ACTION)
    obs = torch.randn(16, len(OBS.order))
    x, layers = obs, mirror.layers()
    for index, (weight, bias) in enumerate(layers):
        x = torch.nn.functional.linear(x, weight, bias)
        x = torch.nn.functional.elu(x) if index < len(layers) - 1 else x
    assert [weight.shape[0] for weight, _ in layers] == [*(2 * width for width in hidden), 12]
    torch.testing.assert_close(x, mirror(obs), atol=1e-5, rtol=1e-5)


def test_gradients_reach_the_network(actor):
    actor(torch.randn(4, len(OBS.order))).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0.0 for p in actor.parameters())


@pytest.mark.parametrize(
    "obs", [(np.array([1, 2, 0]), np.ones(3)), (np.array([1, 0]), np.array([1.0, -1.0])), (np.arange(2), np.ones(3))]
)
def test_image_that_is_not_its_own_inverse_is_refused(obs):
    with pytest.raises(InputError, match="not its own inverse"):
        MirrorActor(torch.nn.Identity(), obs, ACTION)

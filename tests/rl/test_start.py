"""Trainings that begin with the actor of a policy, on a mass on a line."""

import dataclasses
import json

import pytest
import torch
from test_shac import SmoothPushTask

from jumper_warp.rl.checkpoint import load_checkpoint, save_checkpoint
from jumper_warp.rl.mirror import nearest_plain_layers, plain_layers, symmetric_layers, symmetry_of
from jumper_warp.rl.networks import EPS, ActorCritic
from jumper_warp.rl.ppo import Ppo
from jumper_warp.rl.runner import CHECKPOINTS, CONFIG, train
from jumper_warp.rl.start import KNOWN_ITERATIONS, begin_with, make_start
from jumper_warp.utils.errors import InputError
from toy_task import SMALL, PushTask, push_cfg

SYMMETRY = symmetry_of(PushTask(1))
SYMMETRIC = dataclasses.replace(SMALL, symmetry="actor")
OBS = 3.0 * torch.randn(50, 2, generator=torch.Generator().manual_seed(1))


def actor(hidden=(32, 32), symmetry=None):
    """A network that has seen something, with answers of all sizes."""
    torch.manual_seed(7)
    model = ActorCritic(2, 1, hidden, symmetry=symmetry)
    with torch.no_grad():
        model.actor[-1].weight.mul_(30.0)
        for layer in model.actor[::2]:
            layer.bias.normal_()
        model.obs_moments.mean.copy_(torch.tensor([0.0, 0.0] if symmetry else [0.3, -1.0]))
        model.obs_moments.var.copy_(torch.tensor([0.4, 2.0]))
    return model


def layers_of(model):
    return [(layer.weight.detach(), layer.bias.detach()) for layer in model.actor if isinstance(layer, torch.nn.Linear)]


def start_of(model, cfg=SMALL, activation="elu"):
    """Return how a training begins with this actor, exported as a plain network."""
    layers = layers_of(model) if model.symmetry is None else plain_layers(layers_of(model), model.symmetry)
    symmetry = SYMMETRY if cfg.symmetry == "actor" else None
    return make_start(layers, *model.obs_moments.scaling(), activation, cfg, symmetry)


@pytest.fixture
def cfg(tmp_path):
    ppo = dataclasses.replace(SMALL, lr=1e-9, min_lr=1e-9, max_lr=1e-9)
    return push_cfg(tmp_path, max_iterations=1, log_interval=1, ppo=ppo, start_from="pusher")


def make_env(num_envs, seed, device):
    return PushTask(num_envs, seed, device, episode_length=SMALL.num_steps)


def model_of(result):
    return load_checkpoint(result.folder / CHECKPOINTS / f"iteration_{result.iteration:06d}.pt")["ppo"]["model"]


# ---------------------------------------------------------------- layers of a symmetric actor


@pytest.mark.parametrize("hidden", [(16,), (32, 24), (8, 6, 4)])
def test_layers_of_a_symmetric_actor_come_back_from_the_plain_ones(hidden):
    layers = layers_of(actor(hidden, SYMMETRY))
    layers[-1][1].zero_()  # the part of the bias that f(x) and N f(M x) do not cancel is 0 here
    found = symmetric_layers(plain_layers(layers, SYMMETRY), SYMMETRY)
    for own, made in zip(layers, found, strict=True):
        torch.testing.assert_close(made, own, atol=0.0, rtol=0.0)


def changed(layers, index, part):
    layers = [tuple(tensor.clone() for tensor in layer) for layer in layers]
    layers[index][part].view(-1)[-1] += 0.01
    return layers


@pytest.mark.parametrize("index", [0, 1, 2])
@pytest.mark.parametrize("part", [0, 1])
def test_layers_that_are_not_symmetric_are_refused(index, part):
    layers = plain_layers(layers_of(actor(symmetry=SYMMETRY)), SYMMETRY)
    with pytest.raises(InputError, match="not those of a mirror-symmetric actor"):
        symmetric_layers(changed(layers, index, part), SYMMETRY)


@pytest.mark.parametrize("sizes", [(2, 8, 7, 1), (2, 7, 1), (2, 1, 1), (3, 8, 1), (2, 8, 2)])
def test_layers_of_sizes_that_no_symmetric_actor_has_are_refused(sizes):
    layers = layers_of(ActorCritic(sizes[0], sizes[-1], sizes[1:-1]))
    with pytest.raises(InputError, match="not those of a mirror-symmetric actor"):
        symmetric_layers(layers, SYMMETRY)


@pytest.mark.parametrize("hidden", [(16,), (32, 24), (8, 6, 4)])
def test_the_nearest_symmetric_layers_answer_mirrored_and_leave_symmetric_ones_alone(hidden):
    exact = plain_layers(layers_of(actor(hidden, SYMMETRY)), SYMMETRY)
    for own, made in zip(exact, nearest_plain_layers(exact, SYMMETRY), strict=True):
        torch.testing.assert_close(made, own)
    torch.manual_seed(1)
    bent = [tuple(tensor + 0.1 * torch.randn_like(tensor) for tensor in layer) for layer in exact]
    near = nearest_plain_layers(bent, SYMMETRY)
    symmetric_layers(near, SYMMETRY)  # raises if they are not
    rest = torch.cat(
        [(b - n).flatten() for own, made in zip(bent, near, strict=True) for b, n in zip(own, made, strict=True)]
    )
    other = plain_layers(layers_of(actor(hidden, SYMMETRY)), SYMMETRY)
    along = torch.cat(
        [(o - n).flatten() for own, made in zip(other, near, strict=True) for o, n in zip(own, made, strict=True)]
    )
    assert abs(torch.dot(rest, along)) < 1e-4 * rest.norm() * along.norm()  # a foot of the perpendicular


# ---------------------------------------------------------------- beginning


@pytest.mark.parametrize(
    ("given", "symmetry", "hidden"),
    [(None, "off", (32, 32)), (SYMMETRY, "off", (64, 64)), (SYMMETRY, "actor", (32, 32))],
)
def test_a_training_begins_as_the_policy_acts(given, symmetry, hidden):
    model, cfg = actor(symmetry=given), dataclasses.replace(SMALL, symmetry=symmetry, hidden=hidden)
    ppo = Ppo(PushTask(8), cfg)
    before = {name: tensor.clone() for name, tensor in ppo.model.state_dict().items()}
    begin_with(start_of(model, cfg), ppo.model, samples=128)
    torch.testing.assert_close(ppo.model.act(OBS), model.act(OBS), atol=1e-5, rtol=0.0)
    assert ppo.model.obs_moments.count == KNOWN_ITERATIONS * 128
    for name, tensor in ppo.model.state_dict().items():
        assert name.startswith(("actor.", "obs_moments.")) or torch.equal(tensor, before[name]), name
    ppo.env.reset()
    ppo.collect()  # with what was put in, though the collector was made before
    torch.testing.assert_close(ppo.rollout.mean[0].clamp(-1.0, 1.0), model.act(ppo.rollout.obs[0]), atol=1e-5, rtol=0.0)


@pytest.mark.parametrize(
    ("symmetric", "change", "message"),
    [
        (False, {"hidden": (16, 8)}, "has hidden layers 32, 32, these settings make 16, 8: give --ppo.hidden 32 32"),
        (True, {}, "has hidden layers 64, 64, these settings make 32, 32: give --ppo.hidden 64 64"),
        (True, {"symmetry": "actor", "hidden": (9,)}, "layers 64, 64, these settings make 18: give --ppo.hidden 32 32"),
        (False, {"symmetry": "actor", "hidden": (9,)}, "layers 32, 32, these settings make 9: give --ppo.hidden 32 32"),
        (False, {"activation": "tanh"}, "has activation elu, these settings make tanh: give --ppo.activation elu"),
    ],
)
def test_settings_of_another_network_are_refused_in_one_line(symmetric, change, message):
    with pytest.raises(InputError, match=f"start_from: the policy .*{message}") as caught:
        start_of(actor(symmetry=SYMMETRY if symmetric else None), dataclasses.replace(SMALL, **change))
    assert "\n" not in str(caught.value)


def averaged(act, obs):
    """Return what a policy answers, averaged with the image of what it answers to the image."""
    return 0.5 * (act(obs) + SYMMETRY.action.of(act(SYMMETRY.obs.of(obs))))


def test_a_symmetric_training_begins_with_the_average_of_a_policys_answers_and_their_images():
    model, ppo = actor(), Ppo(PushTask(8), SYMMETRIC)
    start = start_of(model, SYMMETRIC)
    begin_with(start, ppo.model, samples=128)
    mean, std = model.obs_moments.scaling()
    obs = 0.5 * OBS  # within the limits of both statistics
    expected = averaged(lambda obs: model.actor((obs - mean) / std), obs).clamp(-1.0, 1.0)
    assert "averaged" in start.change and (expected - model.act(obs)).abs().max() > 0.1
    torch.testing.assert_close(ppo.model.act(obs), expected, atol=1e-5, rtol=0.0)
    mean, std = ppo.model.obs_moments.scaling()
    torch.testing.assert_close(SYMMETRY.obs.of(mean), mean)
    torch.testing.assert_close(std[SYMMETRY.obs.order], std)


def test_statistics_that_are_not_symmetric_make_a_policy_that_is_not():
    model = actor(symmetry=SYMMETRY)
    model.obs_moments.mean[1] = 0.1
    start = start_of(model, dataclasses.replace(SYMMETRIC, hidden=(64, 64)))
    assert "averaged" in start.change and not start_of(actor(symmetry=SYMMETRY), SYMMETRIC).change


def test_a_policy_that_fine_tuning_has_bent_begins_as_the_nearest_symmetric_one():
    exact = plain_layers(layers_of(actor(symmetry=SYMMETRY)), SYMMETRY)
    scaling = actor(symmetry=SYMMETRY).obs_moments.scaling()
    torch.manual_seed(2)
    little, much = ([(w + share * w.std() * torch.randn_like(w), b) for w, b in exact] for share in (0.01, 0.5))
    start = make_start(little, *scaling, "elu", SYMMETRIC, SYMMETRY)
    assert start.change == "made mirror-symmetric"
    for own, made in zip(nearest_plain_layers(little, SYMMETRY), plain_layers(start.layers, SYMMETRY), strict=True):
        torch.testing.assert_close(made, own)
    with pytest.raises(InputError, match=r"give --ppo\.hidden 64 64"):  # averaged, which needs all of its widths
        make_start(much, *scaling, "elu", SYMMETRIC, SYMMETRY)


def test_a_deviation_that_statistics_cannot_have_is_refused():
    model = actor()
    model.obs_moments.var.zero_()
    begin_with(start_of(model), model, samples=1)
    assert (model.obs_moments.var >= 0.0).all() and (model.obs_moments.var < 0.01 * EPS).all()
    with pytest.raises(InputError, match=r"divides an observation by 0\.001, least is 0\.00316"):
        make_start(layers_of(model), torch.zeros(2), torch.tensor([1.0, 1e-3]), "elu", SMALL)


def test_a_model_of_other_sizes_is_left_alone():
    model = ActorCritic(3, 1, (32, 32))
    before = model.actor[0].weight.clone()
    with pytest.raises(InputError, match=r"start_from: .* of shapes \(32, 2\), .* the training's \(32, 3\)"):
        begin_with(start_of(actor()), model, samples=1)
    assert torch.equal(model.actor[0].weight, before) and not model.obs_moments.count


# ---------------------------------------------------------------- trainings


@pytest.mark.parametrize(("trainer", "env"), [("ppo", make_env), ("shac", SmoothPushTask)])
def test_a_training_starts_from_a_policy_and_tells_so(cfg, capsys, trainer, env):
    cfg = dataclasses.replace(cfg, trainer=trainer, shac=dataclasses.replace(cfg.shac, lr=1e-9))
    model = actor()
    result = train(cfg, env, start=start_of(model))
    found, told = model_of(result), capsys.readouterr().err.splitlines()
    assert told[1] == "starts from pusher"
    torch.testing.assert_close(found["actor.0.weight"], model.actor[0].weight.data, atol=1e-6, rtol=0.0)
    torch.testing.assert_close(found["log_std"], torch.zeros(1), atol=1e-6, rtol=0.0)
    samples = 32 * SMALL.num_steps
    assert found["obs_moments.count"] == (KNOWN_ITERATIONS + 1) * samples
    assert 0.0 < (found["obs_moments.mean"] - model.obs_moments.mean).abs().max() < 0.05
    assert json.loads((result.folder / CONFIG).read_text())["train"]["start_from"] == "pusher"


def test_a_resumed_training_goes_on_from_its_checkpoint_and_keeps_what_it_began_with(cfg, capsys):
    first = train(cfg, make_env, start=start_of(actor()))
    capsys.readouterr()
    resumed = dataclasses.replace(cfg, start_from=None, resume=str(first.folder), max_iterations=2)
    second = train(resumed, make_env)
    assert "starts from" not in capsys.readouterr().err
    assert model_of(second)["obs_moments.count"] == (KNOWN_ITERATIONS + 2) * 32 * SMALL.num_steps
    assert json.loads((second.folder / CONFIG).read_text())["train"]["start_from"] == "pusher"


@pytest.mark.parametrize("before", [True, False])
def test_a_checkpoint_that_began_with_random_weights_is_resumed(cfg, before):
    """before: of before there was a choice."""
    first = train(dataclasses.replace(cfg, start_from=None), make_env)
    path = first.folder / CHECKPOINTS / "iteration_000001.pt"
    state = load_checkpoint(path)
    config = json.loads(state["config"])
    assert config["train"].pop("start_from", 0) is None
    save_checkpoint(path.parent, {**state, "config": json.dumps(config) if before else state["config"]})
    result = train(dataclasses.replace(cfg, start_from=None, resume=str(first.folder), max_iterations=2), make_env)
    assert json.loads((result.folder / CONFIG).read_text())["train"]["start_from"] is None


def test_name_and_policy_need_each_other(cfg):
    for start_from, start in (("pusher", None), (None, start_of(actor()))):
        with pytest.raises(InputError, match=r"start_from and start.* need each other"):
            train(dataclasses.replace(cfg, start_from=start_from), make_env, start=start)

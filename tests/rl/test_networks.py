import numpy as np
import pytest
import torch

from jumper_warp.rl.networks import ActorCritic, Moments, RunningMoments, gaussian_kl, gaussian_log_prob


def test_log_prob_and_kl_agree_with_torch():
    torch.manual_seed(0)
    x, mean, new_mean, log_std, new_log_std = (*torch.randn(3, 5, 3), *torch.randn(2, 3))
    old = torch.distributions.Normal(mean, log_std.exp())
    new = torch.distributions.Normal(new_mean, new_log_std.exp())
    torch.testing.assert_close(gaussian_log_prob(x, mean, log_std), old.log_prob(x).sum(-1))
    divergence = torch.distributions.kl_divergence(old, new).sum(-1)
    torch.testing.assert_close(gaussian_kl(mean, log_std, new_mean, new_log_std), divergence)


def test_running_moments_agree_with_numpy_over_all_batches():
    rng = np.random.default_rng(0)
    batches = [rng.normal(50.0, (1.0, 5.0), (size, 2)).astype(np.float32) for size in (3, 400, 77)]
    moments = RunningMoments((2,))
    for batch in batches:
        moments.update(torch.from_numpy(batch))
    samples = np.concatenate(batches).astype(float)
    np.testing.assert_allclose(moments.mean, samples.mean(0), rtol=1e-6)
    np.testing.assert_allclose(moments.var, samples.var(0), rtol=1e-5)
    scaled = moments.scaling().normalise(torch.from_numpy(batches[1]))
    np.testing.assert_allclose(scaled, (batches[1] - samples.mean(0)) / np.sqrt(samples.var(0) + 1e-5), atol=1e-4)
    np.testing.assert_allclose(moments.scaling().denormalise(scaled), batches[1], rtol=1e-5)


@pytest.mark.parametrize("chunk_size", [None, 1, 64, 200, 1000])  # of 200 samples
def test_batch_moments_do_not_depend_on_the_chunk_size(chunk_size):
    batch = np.random.default_rng(0).normal(50.0, (1.0, 5.0), (200, 2)).astype(np.float32)
    mean, var, _ = Moments.from_samples(torch.from_numpy(batch), chunk_size)
    np.testing.assert_allclose(mean, batch.astype(float).mean(0), rtol=1e-6)
    np.testing.assert_allclose(var, batch.astype(float).var(0), rtol=1e-5)


def test_act_returns_the_mean_clipped_to_1():
    model = ActorCritic(2, 1, (4,))
    torch.nn.init.constant_(model.actor[-1].bias, 3.0)  # observations of 0 give a mean of 3
    assert model.act(torch.zeros(5, 2)).tolist() == [[1.0]] * 5


def test_initial_weights_do_not_depend_on_the_number_of_threads():
    weights = []
    before = torch.get_num_threads()
    for threads in (1, 2, 4):
        torch.set_num_threads(threads)
        torch.manual_seed(3)
        model = ActorCritic(147, 12, (256, 128, 128))
        assert torch.get_num_threads() == threads
        weights.append(torch.nn.utils.parameters_to_vector(model.parameters()))
    torch.set_num_threads(before)
    assert all(torch.equal(weights[0], each) for each in weights)

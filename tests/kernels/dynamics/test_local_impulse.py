"""The impulse of one paw while the others' are fixed, against the laws of contact and friction, in float64."""

import numpy as np
import pytest
import warp as wp

from jumper_warp.sim.dynamics import kernel_modules

N = 20000
modules = kernel_modules(double=True)
mat33, vec3, real = modules.scalar.mat33, modules.scalar.vec3, modules.scalar.real
PawContact, local_impulse = modules.contact.PawContact, modules.contact.local_impulse


@wp.kernel
def solve_kernel(
    total: wp.array(dtype=mat33),
    free: wp.array(dtype=vec3),
    normal: wp.array(dtype=vec3),
    mu: wp.array(dtype=real),
    goal: wp.array(dtype=real),
    impulse: wp.array(dtype=vec3),
):
    """Solve one contact a thread, without a first guess."""
    i = wp.tid()
    c = PawContact()
    c.total = total[i]
    c.total_inv = wp.inverse(total[i])
    c.normal = normal[i]
    c.mu = mu[i]
    c.goal = goal[i]
    impulse[i] = local_impulse(c, vec3(), free[i])


def cosines(a, b):
    """Return the cosines of the angles between vectors (n, 3) of two arrays."""
    return (a * b).sum(axis=1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))


@pytest.fixture(scope="module")
def solved():
    """Impulses p and end velocities v of random contacts, split in normal and tangential parts, with mu and goal."""
    rng = np.random.default_rng(7)
    axes = np.linalg.qr(rng.normal(size=(N, 3, 3)))[0]
    response = np.einsum("nij,nj,nkj->nik", axes, 10.0 ** rng.uniform(-1.5, 1.5, (N, 3)), axes)  # [1/kg]
    normal = np.linalg.qr(rng.normal(size=(N, 3, 3)))[0][:, 0]
    free, mu, goal = rng.normal(size=(N, 3)), rng.uniform(0.1, 1.5, N), rng.normal(scale=0.3, size=N)
    impulse = wp.zeros(N, dtype=vec3)
    inputs = [wp.array(x, dtype=t) for x, t in ((response, mat33), (free, vec3), (normal, vec3))]
    wp.launch(solve_kernel, N, [*inputs, wp.array(mu, dtype=real), wp.array(goal, dtype=real)], [impulse])
    p = impulse.numpy()
    v = free + np.einsum("nij,nj->ni", response, p)
    p_n, v_n = (p * normal).sum(axis=1), (v * normal).sum(axis=1)
    return {
        "p_n": p_n, "p_t": p - p_n[:, None] * normal, "v_n": v_n, "v_t": v - v_n[:, None] * normal,
        "mu": mu, "goal": goal, "sticks": np.linalg.norm(v - goal[:, None] * normal, axis=1) < 1e-9,
    }  # fmt: skip


def test_no_impulse_pulls_and_no_contact_closes_further(solved):
    assert solved["p_n"].min() >= 0.0
    assert (solved["v_n"] - solved["goal"]).min() > -1e-9
    pressed = solved["p_n"] > 0.0
    assert 0.2 * N < pressed.sum() < 0.8 * N
    np.testing.assert_allclose(solved["v_n"][pressed], solved["goal"][pressed], atol=1e-9)


def test_friction_is_within_the_cone_where_a_paw_sticks(solved):
    sticks = solved["sticks"] & (solved["p_n"] > 0.0)
    assert sticks.sum() > 0.05 * N
    load = solved["mu"] * solved["p_n"]
    assert (np.linalg.norm(solved["p_t"], axis=1) <= load * (1.0 + 1e-9))[sticks].all()


def test_friction_is_on_the_cone_and_opposes_the_slip_where_a_paw_slides(solved):
    slides = ~solved["sticks"] & (solved["p_n"] > 0.0)
    assert slides.sum() > 0.2 * N
    friction, load = np.linalg.norm(solved["p_t"][slides], axis=1), (solved["mu"] * solved["p_n"])[slides]
    np.testing.assert_allclose(friction, load, rtol=1e-9)
    speed = np.linalg.norm(solved["v_t"][slides], axis=1)
    cosine = cosines(solved["p_t"][slides], solved["v_t"][slides])
    assert cosine[speed > 1e-6].max() < 0.0
    assert (np.sqrt(np.maximum(0.0, 1.0 - cosine**2)) * speed).max() < 1e-6  # [m/s]

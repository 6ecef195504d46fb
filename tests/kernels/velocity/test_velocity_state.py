"""Update of the velocity tracking state against NumPy."""

import numpy as np
import pytest
import warp as wp

from columns import XY
from jump_helpers import make_view
from jumper_warp.kernels.mdp.view import RobotView
from jumper_warp.kernels.velocity.state import VelocityState, advance_velocity
from velocity_helpers import FIELDS

WORLDS, STEPS, SETTLE, DT = 6, 140, 30, 1.0 / 60.0  # SETTLE: policy steps after a command without errors; DT [s]


@wp.kernel(module="unique", enable_backward=False)
def advance_kernel(views: wp.array2d(dtype=RobotView), settle: float, states: wp.array(dtype=VelocityState)):
    """Advance the states through all policy steps; views: (steps, worlds); one thread per world."""
    world = wp.tid()
    state = states[world]
    for step in range(views.shape[0]):
        state = advance_velocity(views[step, world], state, settle)
    states[world] = state


def histories():
    """Return random contacts, first contacts, paw heights [m] (STEPS, WORLDS, 4) and velocities (STEPS, WORLDS, 3)."""
    rng = np.random.default_rng(5)
    down = rng.uniform(size=(STEPS, WORLDS, 4)) < 0.6
    return {
        "down": down,
        "first": down & ~np.concatenate([np.ones((1, WORLDS, 4), dtype=bool), down[:-1]]),
        "height": rng.uniform(0.0, 0.2, (STEPS, WORLDS, 4)),
        "lin_vel": rng.normal(size=(STEPS, WORLDS, 3)),
        "ang_vel": rng.normal(size=(STEPS, WORLDS, 3)),
    }


COMMAND = np.array([0.5, -0.3, 0.7])  # [m/s], [m/s], [rad/s]
PACE = 0.03  # gait cycles per policy step


@pytest.fixture(scope="module")
def followed():
    """Return `histories` and the fields of the states after them by name; world 3 is commanded to stand."""
    h = histories()
    h["lin_vel"][50, 1, 0] = np.nan  # step 50 of world 1; worlds that diverged are not counted
    h["ang_vel"][60, 2, 2] = 1e6  # [rad/s] step 60 of world 2
    views = [
        [
            make_view(
                contact=h["down"][t, w].astype(float), first_contact=h["first"][t, w].astype(float),
                paw_height=h["height"][t, w], lin_vel=h["lin_vel"][t, w], ang_vel=h["ang_vel"][t, w],
            )
            for w in range(WORLDS)
        ]
        for t in range(STEPS)
    ]  # fmt: skip
    states = [VelocityState() for _ in range(WORLDS)]
    for world, state in enumerate(states):
        state.command, state.pace, state.terrain_level = wp.vec3(*COMMAND), PACE, 2
        state.standing = int(world == 3)
    array = wp.array(states, dtype=VelocityState, device="cpu")
    flat = wp.array([view for row in views for view in row], dtype=RobotView, device="cpu")
    wp.launch(advance_kernel, WORLDS, [flat.reshape((STEPS, WORLDS)), float(SETTLE), array], device="cpu")
    records = array.numpy()
    return h, {name: records[name].copy() for name in FIELDS}


def test_recent_steps_counts_touchdowns_of_the_last_45_policy_steps(followed):
    """The count is by paw; some paw touched down in the 46th step from the end, which no longer counts."""
    h, state = followed
    np.testing.assert_array_equal(state["recent_steps"], h["first"][-45:].sum(axis=0))
    assert state["recent_steps"].min() > 3 and (h["first"][-46] & ~h["first"][-45]).any()


def test_errors_and_score_sum_over_settled_finite_policy_steps(followed):
    h, state = followed
    error = np.concatenate([h["lin_vel"][..., XY], h["ang_vel"][..., 2:]], axis=2) - COMMAND
    xy, yaw = np.linalg.norm(error[..., :2], axis=2)[SETTLE:], np.abs(error[..., 2])[SETTLE:]
    fine = (xy < 40.0) & (yaw < 40.0)  # [m/s], [rad/s] MAX_COUNTED_ERROR
    assert (~fine).sum() == 2
    xy, yaw = np.where(fine, xy, 0.0), np.where(fine, yaw, 0.0)
    for total in ("error_xy", "sum_xy"):
        np.testing.assert_allclose(state[total], xy.sum(axis=0), rtol=1e-5)
    for total in ("error_yaw", "sum_yaw"):
        np.testing.assert_allclose(state[total], yaw.sum(axis=0), rtol=1e-5)
    np.testing.assert_array_equal(state["settled"], fine.sum(axis=0))
    speed = np.hypot(0.5, 0.3) + 0.3 * 0.7  # of COMMAND, with yaw weighted by 0.3 m
    score = 1.2 * np.where(fine, speed - 2.0 * (xy + 0.3 * yaw), 0.0).sum(axis=0)  # 1.2: terrain level 2
    np.testing.assert_allclose(state["score"], score, rtol=1e-4)


def test_times_and_gait_phase_advance_with_every_policy_step(followed):
    _, state = followed
    assert set(state["steps"]) == set(state["command_steps"]) == {STEPS} and set(state["all_steps"]) == {STEPS}
    np.testing.assert_allclose(state["minutes"], STEPS * DT / 60.0, rtol=1e-5)
    np.testing.assert_allclose(state["phase"], (PACE * STEPS) % 1.0, atol=1e-4)
    np.testing.assert_allclose(state["seconds_walking"], np.where(np.arange(WORLDS) == 3, 0.0, STEPS * DT), rtol=1e-5)


def test_swing_heights_and_their_sums_at_touchdowns_match_numpy(followed):
    h, state = followed
    apexes, touchdowns, high = np.zeros(WORLDS), np.zeros(WORLDS), np.zeros((WORLDS, 4))  # high: of the swing so far
    for down, first, height in zip(h["down"], h["first"], h["height"], strict=True):
        apexes += (first * high).mean(axis=1)  # means over paws
        touchdowns += first.mean(axis=1)
        high = np.where(down, 0.0, np.maximum(high, height))
    moving = np.arange(WORLDS) != 3  # world 3 is commanded to stand
    np.testing.assert_allclose(state["swing_height"], high, rtol=1e-6)
    np.testing.assert_allclose(state["apexes"], apexes * moving, rtol=1e-5)
    np.testing.assert_allclose(state["touchdowns"], touchdowns * moving, rtol=1e-6)

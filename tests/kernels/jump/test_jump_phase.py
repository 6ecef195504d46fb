import itertools
import math

import numpy as np
import pytest
import warp as wp

from jump_helpers import make_episode, make_view, tilted_by
from jumper_warp.kernels.jump import phase as jump_phase
from jumper_warp.kernels.jump import rewards
from jumper_warp.kernels.jump.phase import advance_jump
from jumper_warp.kernels.jump.state import FLIGHT, LANDED, STANCE, JumpState
from jumper_warp.kernels.mdp.view import RobotView

STEP = 1.0 / 60.0
G = 9.81
TAKEOFF_SPEED = 0.75
HEIGHT = (0.1, 0.05, 0.4)


@wp.kernel(enable_backward=False)
def advance_kernel(
    views: wp.array(dtype=RobotView),
    p: wp.array(dtype=float),
    tasks: wp.array(dtype=JumpState),
    height_reward: wp.array(dtype=float),
    estimate: wp.array(dtype=float),
):
    """Advance an episode through one view after the other; tasks: the beginning, then the state after each."""
    for step in range(views.shape[0]):
        task = advance_jump(views[step], tasks[step], TAKEOFF_SPEED)
        height_reward[step] = rewards.jump_height(views[step], task, p[0], p[1], p[2])
        estimate[step] = rewards.estimated_jump_height(views[step], task, p[0], p[1], p[2])
        tasks[step + 1] = task


def advance(views, start=None):
    """Return the episode after every view as a structured array, jump height rewards, and est jump height rewards."""
    count = len(views)
    start = make_episode() if start is None else start
    tasks = wp.array([start] + [JumpState()] * count, dtype=JumpState, device="cpu")
    for before, view in itertools.pairwise(views):
        view.prev_lin_vel = before.lin_vel
    paid, estimate = (wp.zeros(count, dtype=float, device="cpu") for _ in range(2))
    inputs = [wp.array(views, dtype=RobotView, device="cpu"), wp.array(HEIGHT, dtype=float, device="cpu")]
    wp.launch(advance_kernel, 1, inputs, [tasks, paid, estimate], device="cpu")
    return tasks.numpy()[1:], paid.numpy(), estimate.numpy()


def stand(contacts=4, vz=0.0, z=0.3, **fields):
    return make_view(pos=(0.0, 0.0, z), lin_vel=(0.0, 0.0, vz), contacts=contacts, **fields)


def jump(speed, z=0.4, end=0.3):
    """Return views of a projectile that leaves z [m] upward and comes down to contact at `end` [m], then rests."""
    times = STEP * np.arange(1, 1 + math.ceil((speed + math.sqrt(speed**2 + 2.0 * G * (z - end))) / G / STEP))
    heights = z + speed * times - 0.5 * G * times**2
    flight = [
        stand(0 if h > end else 4, speed - G * t, max(h, end)) for t, h in zip(times, heights, strict=True) if h > end
    ]
    return [stand(), stand(4, speed, z), *flight, *[stand()] * 5]


def test_a_flight_begins_without_contact_and_faster_than_the_takeoff_speed():
    views = [stand(4, 2.0), stand(1, 2.0), stand(0, 0.7), stand(0, 0.8), stand(0, 0.1)]
    tasks, _, _ = advance(views)
    assert tasks["phase"].tolist() == [STANCE, STANCE, STANCE, FLIGHT, FLIGHT]
    assert tasks["took_off"].tolist() == [0, 0, 0, 1, 0]


def test_a_flight_ends_with_the_first_contact_and_landed_is_final():
    tasks, _, _ = advance([stand(0, 2.0), stand(0, -1.0), stand(1, -2.0), stand(0, 3.0), stand(4)])
    assert tasks["phase"].tolist() == [FLIGHT, FLIGHT, LANDED, LANDED, LANDED]
    assert tasks["touched_down"].tolist() == [0, 0, 1, 0, 0]
    np.testing.assert_allclose(tasks["touchdown_vel"][2:, 2], -1.0)  # of the step before the contact


def test_steps_count_in_the_episode_and_in_the_phase():
    tasks, _, _ = advance([stand(), stand(0, 2.0), stand(0, 1.0), stand(2, -1.0), stand()])
    assert tasks["steps"].tolist() == [1, 2, 3, 4, 5]
    assert tasks["phase_steps"].tolist() == [1, 0, 1, 0, 1]


@pytest.mark.parametrize("speed", [1.0, 2.0, 3.7])
def test_the_apex_is_found_and_paid_exactly_once(speed):
    tasks, paid, estimate = advance(jump(speed), make_episode(goal=(0.0, 0.0, 0.9)))
    at_apex = np.flatnonzero(tasks["at_apex"])
    assert len(at_apex) == 1
    apex = 0.4 + speed**2 / (2.0 * G)
    sampled = 0.5 * G * (0.5 * STEP) ** 2  # [m] the apex lies at most half a step from a sample
    assert apex - sampled - 1e-5 <= tasks["max_height"][-1] <= apex + 1e-5
    assert np.flatnonzero(paid).tolist() == at_apex.tolist()
    reached = float(tasks["max_height"][-1])
    assert paid.sum() == pytest.approx(rewards.height_closeness(reached - 0.9, *HEIGHT))
    # est jump height: from takeoff (in flight from the third view on) to the step before the apex
    assert np.flatnonzero(estimate).tolist() == list(range(2, at_apex[0]))
    # a projectile's estimate does not change: the final height all the way
    exact = rewards.height_closeness(apex - 0.9, *HEIGHT)
    np.testing.assert_allclose(estimate[2 : at_apex[0]], exact, rtol=1e-3)


def test_touching_down_while_rising_pays_the_height_reached():
    # onto a step, before the apex
    tasks, paid, _ = advance([stand(0, 3.0, 0.5), stand(0, 2.8, 0.55), stand(2, 2.6, 0.6), stand(4, 0.0, 0.62)])
    assert tasks["at_apex"].tolist() == [0, 0, 1, 0]
    assert tasks["max_height"][-1] == pytest.approx(0.6)
    assert np.count_nonzero(paid) == 1


def test_an_episode_that_begins_behind_the_apex_is_not_paid_for_it():
    falling = make_episode(phase=FLIGHT, apex_passed=1, max_height=0.8, goal=(0.0, 0.0, 0.8))
    tasks, paid, estimate = advance([stand(0, -1.0, 0.6), stand(0, -1.2, 0.5), stand(4, -0.5, 0.4)], falling)
    assert not tasks["at_apex"].any() and not paid.any() and not estimate.any()
    assert tasks["max_height"].tolist() == pytest.approx([0.8] * 3)


def test_what_happens_before_takeoff_does_not_count_as_height():
    tasks, _, _ = advance([stand(4, 0.0, 0.9), stand(0, 2.0, 0.4), stand(0, 1.8, 0.43), stand(0, -0.1, 0.5)])
    assert tasks["max_height"][1:].tolist() == pytest.approx([0.4, 0.43, 0.5])


def test_idle_steps_count_slow_stance_while_a_jump_is_commanded():
    views = [stand(vz=0.0), stand(vz=0.09), stand(vz=-0.09), stand(vz=0.11), stand(vz=0.0), stand(0, 2.0), stand()]
    tasks, _, _ = advance(views, make_episode(command_step=2))
    assert tasks["idle_steps"].tolist() == [0, 1, 2, 0, 1, 0, 0]


def test_the_largest_tilt_since_touchdown_is_kept():
    views = [stand(0, 2.0, **tilted_by(0.9)), stand(2, -1.0, **tilted_by(0.1)), stand(4, **tilted_by(0.4)), stand(4)]
    tasks, _, _ = advance(views)
    assert tasks["peak_tilt"].tolist() == pytest.approx([0.0, 0.1, 0.4, 0.4], abs=1e-3)


def integrate(pos, vel, height):
    """Return apex [m] and the place (x, y) [m] where a point mass falls through a height, by small steps."""
    pos, vel, dt, apex = np.array(pos), np.array(vel), 1.0e-4, pos[2]
    while vel[2] > 0.0 or pos[2] > height:
        before = pos.copy()
        pos += dt * (vel + 0.5 * dt * np.array([0.0, 0.0, -G]))
        vel[2] -= dt * G
        apex = max(apex, pos[2])
    share = (before[2] - height) / (before[2] - pos[2])
    return apex, before[:2] + share * (pos - before)[:2]


@pytest.mark.parametrize(
    ("pos", "vel", "height"),
    [
        ((0.1, -0.2, 0.5), (1.5, -0.4, 3.0), 0.3),
        ((0.0, 0.0, 0.8), (2.0, 0.3, -1.0), 0.3),
        ((1.0, 0.0, 0.3), (1.0, 1.0, 2.5), 0.4),
    ],
)
def test_the_ballistic_estimate_agrees_with_integration(pos, vel, height):
    apex, landing = integrate(pos, vel, height)
    assert jump_phase.estimated_apex(wp.vec3(*pos), wp.vec3(*vel), G) == pytest.approx(apex, abs=1e-4)
    found = jump_phase.estimated_landing(wp.vec3(*pos), wp.vec3(*vel), height, G)
    np.testing.assert_allclose(list(found), landing, atol=1e-3)


def test_a_projectile_that_never_reaches_a_height_lands_nowhere_else():
    # at 0.2 m, falling: below 0.3 m already, so the estimate stays where it is
    found = jump_phase.estimated_landing(wp.vec3(0.5, 0.6, 0.2), wp.vec3(1.0, 1.0, -0.5), 0.3, G)
    np.testing.assert_allclose(list(found), [0.5, 0.6], atol=1e-6)
    assert jump_phase.estimated_apex(wp.vec3(0.0, 0.0, 0.2), wp.vec3(0.0, 0.0, -5.0), G) == pytest.approx(0.2)


def test_paws_count_as_landed_from_their_own_first_contact_after_the_touchdown():
    down = [(0, 0, 0, 0), (1, 0, 0, 0), (1, 1, 0, 0), (0, 1, 0, 0), (0, 1, 1, 1)]
    views = [stand(sum(paws), contact=np.array(paws, dtype=float)) for paws in down]
    flying = make_episode(phase=FLIGHT, apex_passed=1, paws_landed=15)
    states, _, _ = advance(views, flying)
    assert states["phase"].tolist() == [int(FLIGHT)] + 4 * [int(LANDED)]
    assert states["paws_landed"][1:].tolist() == [1, 3, 3, 15]

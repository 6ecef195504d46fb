"""Phases of jumps and their apex by scripted motions, and the ballistic estimates by integration."""

import itertools
import math

import numpy as np
import pytest
import warp as wp

from jump_helpers import PHASES, make_episode, make_view, tilted_by
from jumper_warp.kernels.jump import phase as jump_phase
from jumper_warp.kernels.jump import rewards
from jumper_warp.kernels.jump.phase import advance_jump
from jumper_warp.kernels.jump.state import JumpState
from jumper_warp.kernels.mdp.view import RobotView

S, F, L = PHASES
STEP = 1.0 / 60.0  # [s]
G = 9.81  # [m/s^2]
TAKEOFF_SPEED = 0.75  # [m/s]
HEIGHT = (0.1, 0.05, 0.4)  # [m] std_fine, scale_sharp, std_wide of `height_closeness`


@wp.kernel(enable_backward=False)
def advance_kernel(
    views: wp.array(dtype=RobotView), p: wp.array(dtype=float), tasks: wp.array(dtype=JumpState),
    height_reward: wp.array(dtype=float), estimate: wp.array(dtype=float),
):  # fmt: skip
    """Advance an episode through all views; tasks: (views + 1,), initial state, then the state after each view."""
    for step in range(views.shape[0]):
        task = advance_jump(views[step], tasks[step], TAKEOFF_SPEED)
        height_reward[step] = rewards.jump_height(views[step], task, p[0], p[1], p[2])
        estimate[step] = rewards.estimated_jump_height(views[step], task, p[0], p[1], p[2])
        tasks[step + 1] = task


def advance(views, start=None):
    """Return, per view, the episode after it (structured array), jump height and est jump height reward."""
    count = len(views)
    start = make_episode() if start is None else start
    tasks = wp.array([start] + [JumpState()] * count, dtype=JumpState, device="cpu")
    for before, view in itertools.pairwise(views):
        view.prev_lin_vel = before.lin_vel
    height_reward, estimate = (wp.zeros(count, dtype=float, device="cpu") for _ in range(2))
    inputs = [wp.array(views, dtype=RobotView, device="cpu"), wp.array(HEIGHT, dtype=float, device="cpu")]
    wp.launch(advance_kernel, 1, inputs, [tasks, height_reward, estimate], device="cpu")
    return tasks.numpy()[1:], height_reward.numpy(), estimate.numpy()


def views_of(contacts, up=0.0, z=0.3):
    """Return a list of views: numbers of paws in contact, upward speeds [m/s] and heights [m] of the base, by step."""
    return [
        make_view(pos=(0.0, 0.0, float(height)), lin_vel=(0.0, 0.0, float(speed)), contacts=int(paws))
        for paws, speed, height in zip(*np.broadcast_arrays(contacts, up, z), strict=True)
    ]


def jump_views(speed, z=0.4, end=0.3):
    """Return views of a jump: stance, takeoff at z [m] with `speed` [m/s], projectile down to `end` [m], 5 at rest."""
    times = STEP * np.arange(1, 1 + math.ceil((speed + math.sqrt(speed**2 + 2.0 * G * (z - end))) / G / STEP))
    heights = z + speed * times - 0.5 * G * times**2
    times, heights = times[heights > end], heights[heights > end]
    before = views_of(contacts=(4, 4), up=(0.0, speed), z=(0.3, z))
    return [*before, *views_of(contacts=0, up=speed - G * times, z=heights), *views_of(contacts=[4] * 5)]


HIGHEST = (0.15, 0.17, 0.18, 0.20, 0.23, 0.30, 0.35, 0.50, 0.55, 0.45, 0.30, 0.25)
MOTIONS = {  # paws in contact, upward speeds [m/s], heights [m], first episode, fields after each step
    "a flight begins without contact and faster than the takeoff speed": (
        (4, 1, 0, 0, 0), (2.0, 2.0, 0.7, 0.8, 0.1), 0.3, {},
        {"phase": [S, S, S, F, F], "took_off": [0, 0, 0, 1, 0]}),
    "a flight ends with the first contact, and landed is final": (
        (0, 0, 1, 0, 4), (2.0, -1.0, -2.0, 3.0, 0.0), 0.3, {},
        {"phase": [F, F, L, L, L], "touched_down": [0, 0, 1, 0, 0]}),
    # its contact breaks for two steps: the takeoff moves on with the contact
    "contact while the base rises belongs to the push-off": (
        (4, 0, 0, 2, 4, 2, 0, 0, 0, 0, 1, 4), (0.5, 1.0, 0.9, 1.3, 2.0, 2.6, 2.5, 1.2, -0.1, -1.5, -2.4, -1.0),
        HIGHEST, {},
        {"phase": [S] + 9 * [F] + 2 * [L], "touched_down": 10 * [0] + [1, 0], "at_apex": 8 * [0] + [1, 0, 0, 0],
         "took_off": [0, 1, 0, 1, 1, 1] + 6 * [0], "phase_steps": [1, 0, 1, 0, 0, 0, 1, 2, 3, 4, 0, 1],
         "max_height": [0.0, *HIGHEST[1:9], 0.55, 0.55, 0.55]}),
    **{f"contact ends a flight at {speed} m/s": (
        (0, 0, 1, 0), (2.0, 1.0, speed, 2.0), 0.3, {}, {"phase": [F, F, L, L]})
       for speed in (TAKEOFF_SPEED - 0.01, 0.0, -1.0)},
    "a paw that clips an edge on the way up does not end the flight": (
        (0, 1, 0, 0, 2), (2.0, 0.8, 0.7, -1.0, -1.5), 0.3, {}, {"phase": [F, F, F, F, L]}),
    "steps count in the episode and in the phase": (
        (4, 0, 0, 2, 4), (0.0, 2.0, 1.0, -1.0, 0.0), 0.3, {},
        {"steps": [1, 2, 3, 4, 5], "phase_steps": [1, 0, 1, 0, 1]}),
    "touching down while rising is the apex": (
        (0, 0, 2, 4), (3.0, 2.8, 0.7, 0.0), (0.5, 0.55, 0.6, 0.62), {},
        {"at_apex": [0, 0, 1, 0], "max_height": [0.5, 0.55, 0.6, 0.6]}),
    "an episode that begins past the apex has none": (
        (0, 0, 4), (-1.0, -1.2, -0.5), (0.6, 0.5, 0.4), {"phase": F, "apex_passed": 1, "max_height": 0.8},
        {"at_apex": [0, 0, 0], "max_height": [0.8] * 3}),
    "heights before takeoff do not count": (
        (4, 0, 0, 0), (0.0, 2.0, 1.8, -0.1), (0.9, 0.4, 0.43, 0.5), {}, {"max_height": [0.0, 0.4, 0.43, 0.5]}),
    "idle steps are slow stance while a jump is commanded": (  # slow: below 0.1 m/s
        (4, 4, 4, 4, 4, 0, 4), (0.0, 0.09, -0.09, 0.11, 0.0, 2.0, 0.0), 0.3, {"command_step": 2},
        {"idle_steps": [0, 1, 2, 0, 1, 0, 0]}),
    "the squat is the lowest height from the command to the takeoff": (
        (4, 4, 4, 4, 4, 0, 4), (0.0,) * 5 + (2.0, 0.0), (0.20, 0.35, 0.30, 0.25, 0.28, 0.40, 0.22), {"command_step": 2},
        {"squat": [0.20, 0.35, 0.30, 0.25, 0.25, 0.25, 0.25]}),
}  # fmt: skip


@pytest.mark.parametrize("motion", MOTIONS)
def test_state_of_a_scripted_motion(motion):
    *views, start, expected = MOTIONS[motion]
    tasks, height_reward, _ = advance(views_of(*views), make_episode(**start))
    for name, values in expected.items():
        assert tasks[name].tolist() == pytest.approx(values), name
    np.testing.assert_array_equal(height_reward > 0.0, tasks["at_apex"])


def test_states_read_velocity_tilt_and_contacts_since_touchdown():
    views = views_of((0, 2, 4, 4), (2.0, -1.0, 0.0, 0.0))
    down = [(0, 0, 0, 0), (1, 0, 0, 0), (1, 1, 0, 0), (0, 1, 1, 1)]  # FL, FR, BL, BR, by step
    for view, tilt, paws in zip(views, (0.9, 0.1, 0.4, 0.0), down, strict=True):  # [rad]
        view.projected_gravity = wp.vec3(*tilted_by(tilt)["projected_gravity"])
        view.contact = wp.vec4(*map(float, paws))
    tasks, _, _ = advance(views, make_episode(phase=F, apex_passed=1, paws_landed=0b1111))
    assert tasks["phase"].tolist() == [F, L, L, L]
    assert tasks["peak_tilt"].tolist() == pytest.approx([0.0, 0.1, 0.4, 0.4], abs=1e-3)
    assert tasks["paws_landed"][1:].tolist() == [0b0001, 0b0011, 0b1111]
    np.testing.assert_allclose(tasks["touchdown_vel"][1:, 2], 2.0)  # [m/s] of the step before the contact


@pytest.mark.parametrize("speed", [1.0, 2.0, 3.7])
def test_apex_and_height_rewards_of_a_projectile(speed):
    tasks, height_reward, estimate = advance(jump_views(speed), make_episode(goal=(0.0, 0.0, 0.9)))
    at_apex = np.flatnonzero(tasks["at_apex"])
    assert len(at_apex) == 1
    apex = 0.4 + speed**2 / (2.0 * G)  # [m]
    sampled = 0.5 * G * (0.5 * STEP) ** 2  # [m] the apex lies at most half a step from a sample
    assert apex - sampled - 1e-5 <= tasks["max_height"][-1] <= apex + 1e-5
    assert np.flatnonzero(height_reward).tolist() == at_apex.tolist()
    reached = float(tasks["max_height"][-1])
    assert height_reward.sum() == pytest.approx(rewards.height_closeness(reached - 0.9, *HEIGHT))
    # est jump height: from takeoff (in flight from the third view on) to the step before the apex
    assert np.flatnonzero(estimate).tolist() == list(range(2, at_apex[0]))
    # a projectile's estimate does not change: the final height all the way
    exact = rewards.height_closeness(apex - 0.9, *HEIGHT)
    np.testing.assert_allclose(estimate[2 : at_apex[0]], exact, rtol=1e-3)


def integrated_flight(pos, vel, height):
    """Return apex [m] and position (x, y) [m] at which a point mass falls through `height` [m]; steps of 0.1 ms."""
    pos, vel, dt, apex = np.array(pos), np.array(vel), 1.0e-4, pos[2]
    while vel[2] > 0.0 or pos[2] > height:
        before = pos.copy()
        pos += dt * (vel + 0.5 * dt * np.array([0.0, 0.0, -G]))
        vel[2] -= dt * G
        apex = max(apex, pos[2])
    fraction = (before[2] - height) / (before[2] - pos[2])  # of the last step
    return apex, before[:2] + fraction * (pos - before)[:2]


@pytest.mark.parametrize(
    ("pos", "vel", "height"),
    [((0.1, -0.2, 0.5), (1.5, -0.4, 3.0), 0.3), ((0.0, 0.0, 0.8), (2.0, 0.3, -1.0), 0.3),
     ((1.0, 0.0, 0.3), (1.0, 1.0, 2.5), 0.4)],
)  # fmt: skip
def test_the_ballistic_estimate_agrees_with_integration(pos, vel, height):
    apex, landing = integrated_flight(pos, vel, height)
    assert jump_phase.estimated_apex(wp.vec3(*pos), wp.vec3(*vel), G) == pytest.approx(apex, abs=1e-4)
    estimate = jump_phase.estimated_landing(wp.vec3(*pos), wp.vec3(*vel), height, G)
    np.testing.assert_allclose(list(estimate), landing, atol=1e-3)


def test_the_estimate_of_a_projectile_that_falls_below_the_height_is_its_present_position():
    landing = jump_phase.estimated_landing(wp.vec3(0.5, 0.6, 0.2), wp.vec3(1.0, 1.0, -0.5), 0.3, G)
    np.testing.assert_allclose(list(landing), [0.5, 0.6], atol=1e-6)
    assert jump_phase.estimated_apex(wp.vec3(0.0, 0.0, 0.2), wp.vec3(0.0, 0.0, -5.0), G) == pytest.approx(0.2)

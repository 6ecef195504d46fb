import pytest
from scipy.spatial.transform import Rotation

from jump_helpers import DEG, Table, functions, make_episode, make_view
from jump_oracle import FLIGHT, LANDED, STANCE
from jumper_warp.kernels.jump import terminations
from jumper_warp.registry import make_task

holds = Table(functions(terminations, "missed_goal predicted_miss turned_touchdown left_stance second_takeoff"), bool)
"""holds(name, view, episode, **numbers): whether a termination holds."""
PREDICTED = {"tolerance": 0.55, "steps": 6.0, "height": 0.3}  # [m], policy steps, [m]
HEADINGS = [0.0, 100.0, 175.0, 180.0, -175.0]  # [deg]


@pytest.mark.parametrize(
    ("phase", "contacts", "up", "ends"),  # up: [m/s]
    [
        (LANDED, 0, 0.26, True), (LANDED, 0, 0.24, False), (LANDED, 1, 2.0, False), (FLIGHT, 0, 2.0, False),
        (STANCE, 0, 2.0, False),
    ],
)  # fmt: skip
def test_second_takeoff_is_upward_after_touchdown_with_no_paw_down(phase, contacts, up, ends):
    view = make_view(contacts=contacts, lin_vel=(3.0, 0.0, up))
    assert holds("second_takeoff", view, make_episode(phase=phase), speed=0.25) is ends


@pytest.mark.parametrize(("miss", "missed"), [(0.49, False), (0.51, True)])
def test_missed_goal_counts_at_touchdown_in_the_plane(miss, missed):
    view = make_view(pos=(1.0 - 0.6 * miss, 2.0 + 0.8 * miss, 0.9))
    touching = make_episode(phase=LANDED, touched_down=1, goal=(1.0, 2.0, 0.0))
    assert holds("missed_goal", view, touching, tolerance=0.5) is missed
    for episode in ({"phase": FLIGHT}, {"phase": LANDED, "phase_steps": 1}, {"phase": STANCE}):
        assert not holds("missed_goal", view, make_episode(goal=(1.0, 2.0, 0.0), **episode), tolerance=0.5)


@pytest.mark.parametrize(("miss", "missed"), [(0.54, False), (0.56, True)])
def test_predicted_miss_is_decided_once_a_tenth_of_a_second_after_takeoff(miss, missed):
    # half a second from 0.52625 m upward with 2 m/s to 0.3 m
    view = make_view(pos=(0.2, 0.3, 0.52625), lin_vel=(1.0, -0.6, 2.0))
    goal = (0.7 + 0.6 * miss, -0.8 * miss, 0.0)
    for steps in range(12):
        flying = make_episode(phase=FLIGHT, phase_steps=steps, goal=goal)
        assert holds("predicted_miss", view, flying, **PREDICTED) is (missed and steps == 6)
    for phase in (STANCE, LANDED):
        elsewhere = make_episode(phase=phase, phase_steps=6, goal=goal)
        assert not holds("predicted_miss", view, elsewhere, **PREDICTED)


@pytest.mark.parametrize(("miss", "missed"), [(0.54, False), (0.56, True)])
def test_predicted_miss_is_computed_above_the_ground_at_the_goal(miss, missed):
    view = make_view(pos=(0.2, 0.0, 0.60625), lin_vel=(1.0, 0.0, 2.0))  # half a second to 0.38 m
    flying = make_episode(phase=FLIGHT, phase_steps=6, goal=(0.7 + miss, 0.0, 0.0), goal_ground=0.08)
    assert holds("predicted_miss", view, flying, **PREDICTED) is missed


def test_times_of_the_tasks_terminations_are_whole_policy_steps():
    numbers = {term.name: term.numbers for term in make_task("horizontal-jump").terminations}
    assert numbers["predicted_miss"]["steps"] == 6.0 and numbers["success"] == {"steps": 60.0}


@pytest.mark.parametrize("heading", HEADINGS)
@pytest.mark.parametrize(
    ("yaw", "pitch", "is_turned"),
    [
        (0.0, 0.0, False),
        (9.5, 0.0, False),
        (-9.5, 0.0, False),
        (10.5, 0.0, True),
        (-10.5, 0.0, True),
        (0.0, 29.5, False),
        (0.0, 30.5, True),
        (9.0, 29.0, True),  # neither alone, but 30.3 degrees together
        (9.0, 28.0, False),  # 29.4 degrees
        (180.0, 0.0, True),
    ],
)
def test_turned_touchdown_measures_from_the_heading_across_180_degrees(heading, yaw, pitch, is_turned):
    quat = Rotation.from_euler("ZYX", [heading + yaw, pitch, 0.0], degrees=True).as_quat()
    limits = {"rotation": 30.0 * DEG, "yaw": 10.0 * DEG}
    for sign in (1.0, -1.0):
        view = make_view(quat=sign * quat)
        touching = make_episode(phase=LANDED, touched_down=1, heading=heading * DEG)
        assert holds("turned_touchdown", view, touching, **limits) is is_turned
        assert not holds("turned_touchdown", view, make_episode(phase=LANDED, heading=heading * DEG), **limits)


def test_left_stance_is_measured_in_the_plane_while_standing():
    fields = {"start": (1.0, -1.0, 0.3)}
    for miss, left in ((0.29, False), (0.31, True)):
        view = make_view(pos=(1.0 + 0.6 * miss, -1.0 - 0.8 * miss, 0.9))
        assert holds("left_stance", view, make_episode(**fields), distance=0.3) is left
        for phase in (FLIGHT, LANDED):
            assert not holds("left_stance", view, make_episode(phase=phase, **fields), distance=0.3)

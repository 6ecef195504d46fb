"""Module `mdp`: its public names, and that scripts and documents import it in place of kernels."""

import pytest
import warp as wp

import hold_height
from jumper_warp import mdp


def test_curriculum_counts_every_episode_by_default():
    curriculum = mdp.Curriculum(hold_height.height_error, tolerance=0.1)
    assert curriculum.options["counts"].func(None) is True


@pytest.mark.parametrize(
    ("contacts", "speed", "flies"),
    [
        (0, 0.8, (True, True)),  # rises with no paw down
        (0, 0.7, (False, True)),  # squats with no paw down, or falls in a flight
        (4, 0.8, (False, True)),  # pushes off, or touches an edge
        (1, 0.7, (False, False)),  # touches down
    ],
)
def test_flight_begins_with_a_rise_without_contact_and_ends_with_contact(contacts, speed, flies):
    robot = mdp.RobotView()
    robot.contacts = contacts
    robot.lin_vel = wp.vec3(0.0, 0.0, speed)
    assert tuple(mdp.in_flight(robot, flying, 0.75) for flying in (False, True)) == flies

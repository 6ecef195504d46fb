import pytest

from jump_helpers import Table, functions, make_episode, make_view
from jumper_warp.kernels.jump import terminations
from jumper_warp.kernels.jump.state import FLIGHT, LANDED, STANCE

NAMES = (
    "landed_for wrong_height low_touchdown moved_away slanted_takeoff hard_impact no_jump early_takeoff second_takeoff "
    "shallow_squat crouched"
)
holds = Table(functions(terminations, NAMES), bool)
"""holds(name, view, episode, **numbers): whether a termination holds."""


def test_landed_for_holds_after_its_steps_since_touchdown():
    for steps, over in ((59, False), (60, True)):
        landed = make_episode(phase=LANDED, phase_steps=steps)
        assert holds("landed_for", make_view(), landed, steps=60.0) is over
    for phase in (STANCE, FLIGHT):
        elsewhere = make_episode(phase=phase, phase_steps=200)
        assert not holds("landed_for", make_view(), elsewhere, steps=60.0)


@pytest.mark.parametrize(
    ("error", "missed"), [(0.0, False), (0.09, False), (-0.09, False), (0.11, True), (-0.11, True)]
)
def test_wrong_height_counts_at_touchdown(error, missed):
    fields = {"goal": (0.0, 0.0, 0.8), "max_height": 0.8 + error, "phase": LANDED}
    assert holds("wrong_height", make_view(), make_episode(touched_down=1, **fields), tolerance=0.1) is missed
    assert not holds("wrong_height", make_view(), make_episode(touched_down=0, **fields), tolerance=0.1)


def test_low_touchdown_is_a_base_below_its_height_at_touchdown_only():
    for z, low in ((0.21, False), (0.19, True)):
        view = make_view(pos=(0.0, 0.0, z))
        assert holds("low_touchdown", view, make_episode(touched_down=1), height=0.2) is low
        assert not holds("low_touchdown", view, make_episode(touched_down=0), height=0.2)


def test_moved_away_is_measured_in_the_plane_from_the_start():
    start = make_episode(start=(1.0, -1.0, 0.3))
    assert not holds("moved_away", make_view(pos=(1.11, -0.85, 1.2)), start, distance=0.2)  # 0.186 m
    assert holds("moved_away", make_view(pos=(1.13, -0.84, 0.3)), start, distance=0.2)  # 0.206 m


def test_slanted_takeoff_is_a_horizontal_speed_above_its_limit_at_takeoff_only():
    for vx, slanted in ((0.59, False), (0.61, True)):
        view = make_view(lin_vel=(vx, -0.45, 3.0))  # 0.6, 0.45: 0.75 m/s
        assert holds("slanted_takeoff", view, make_episode(phase=FLIGHT, took_off=1), speed=0.75) is slanted
        assert not holds("slanted_takeoff", view, make_episode(phase=FLIGHT), speed=0.75)


@pytest.mark.parametrize(
    ("phase", "limit"), [(int(STANCE), 25.0), (int(FLIGHT), 50.0), (int(LANDED), 50.0)], ids=["stance", "air", "landed"]
)
def test_hard_impact_has_a_limit_for_stance_and_one_for_the_rest(phase, limit):
    task = make_episode(phase=phase)
    for acc, hard in ((limit - 0.1, False), (limit + 0.1, True), (-limit - 0.1, False)):
        falling = make_view(
            prev_lin_vel=(0.0, 0.0, -1.0), lin_acc=(0.0, 0.0, acc), lin_vel=(0.0, 0.0, -1.0 + acc / 60.0)
        )
        assert holds("hard_impact", falling, task, stance=25.0, flight=50.0) is hard


def test_a_landing_that_stops_within_a_step_is_a_hard_impact():
    # 3 m/s lost in 1/60 s: 180 m/s^2
    stopped = make_view(prev_lin_vel=(0.0, 0.0, -3.0), lin_acc=(0.0, 0.0, 180.0))
    assert holds("hard_impact", stopped, make_episode(phase=LANDED, touched_down=1), stance=25.0, flight=50.0)


def test_no_jump_holds_in_stance_too_long_after_the_command_or_at_rest():
    view, limits = make_view(), {"steps": 180.0, "idle_steps": 60.0}
    assert not holds("no_jump", view, make_episode(steps=210, command_step=30), **limits)
    assert holds("no_jump", view, make_episode(steps=211, command_step=30), **limits)
    assert not holds("no_jump", view, make_episode(steps=100, command_step=30, idle_steps=60), **limits)
    assert holds("no_jump", view, make_episode(steps=100, command_step=30, idle_steps=61), **limits)
    for phase in (FLIGHT, LANDED):
        assert not holds("no_jump", view, make_episode(phase=phase, steps=999, idle_steps=99), **limits)
    assert not holds("no_jump", view, make_episode(steps=20, command_step=30, idle_steps=99), **limits)


def test_early_takeoff_is_a_takeoff_before_the_command_step():
    jumped = {"phase": FLIGHT, "command_step": 30}
    assert holds("early_takeoff", make_view(), make_episode(took_off=1, steps=29, **jumped))
    assert not holds("early_takeoff", make_view(), make_episode(took_off=1, steps=30, **jumped))
    assert not holds("early_takeoff", make_view(), make_episode(took_off=0, steps=29, **jumped))


def test_shallow_squat_is_a_takeoff_from_above_the_wanted_squat():
    numbers = {"tolerance": 0.04, "takeoff_height": 0.3, "acceleration": 50.0, "floor": 0.15}
    for squat, shallow in ((0.240, False), (0.243, True)):  # wanted: 0.3 - 9.81 * 0.5 / 50 = 0.2019 m
        fields = {"phase": FLIGHT, "squat": squat, "goal": (0.0, 0.0, 0.8)}
        assert holds("shallow_squat", make_view(), make_episode(took_off=1, **fields), **numbers) is shallow
        assert not holds("shallow_squat", make_view(), make_episode(took_off=0, **fields), **numbers)


def test_crouched_holds_before_the_command_and_after_the_landing_once_the_time_to_stand_up_is_over():
    numbers = {"height": 0.28, "start_steps": 18.0, "landing_steps": 90.0}
    low, high = make_view(pos=(0.0, 0.0, 0.27)), make_view(pos=(0.0, 0.0, 0.29))
    waiting = make_episode(steps=19, command_step=60)
    assert holds("crouched", low, waiting, **numbers) and not holds("crouched", high, waiting, **numbers)
    assert not holds("crouched", low, make_episode(steps=18, command_step=60), **numbers)
    assert not holds("crouched", low, make_episode(steps=60, command_step=60), **numbers)  # it squats for the jump
    for steps, ended in ((90, False), (91, True)):
        landed = make_episode(phase=LANDED, steps=200, phase_steps=steps)
        assert holds("crouched", low, landed, **numbers) is ended
        assert not holds("crouched", high, landed, **numbers)
    assert not holds("crouched", low, make_episode(phase=FLIGHT, phase_steps=200), **numbers)

"""The runtime on simulated buses in lockstep: standing up, walking, jumping, and replaying the log."""

from types import SimpleNamespace

import numpy as np
import pytest

from jumper_warp.bench.bus_sim import BusFaults
from jumper_warp.bench.logs import LogCfg, motions_of_log, play_log, simulated_again
from jumper_warp.deploy.estimator import Estimator
from jumper_warp.deploy.log import Log, read_log, replay
from jumper_warp.deploy.motions import joint_test
from jumper_warp.deploy.runtime import Request, State
from jumper_warp.deploy.safety import Fault
from jumper_warp.deploy.sensors import MotionCapture
from jumper_warp.utils.errors import InputError


def run_until(robot, state, ticks=4000):
    """Run until a state, at most some ticks; return the greatest height of the base [m]."""
    height = 0.0
    for _ in range(ticks):
        robot.run(1)
        height = max(height, robot.far.q[2])
        if robot.runtime.state == state:
            return height
    raise AssertionError(f"in state {robot.runtime.state.name}, not {state.name}: {robot.runtime.reason.name}")


def test_walk_and_jump_to_a_place_replay_bit_for_bit(make_robot, bundle, tmp_path):
    log = Log(tmp_path / "log", bundle, 480, capture=True, frames="frames.asc")
    robot = make_robot()
    robot.runtime.listener = log.tick
    robot.link.listener = log.frame
    robot.run(360)
    assert robot.runtime.state == State.PASSIVE and not robot.far.enabled.any()
    robot.run(150, Request.STAND)
    assert robot.runtime.state == State.STAND_UP and robot.far.enabled.all()
    assert robot.far.q[2] < 0.3  # [m] it waits for the confirmation
    robot.run(1, Request.CONFIRM)
    run_until(robot, State.HOLD)
    assert robot.far.q[2] > 0.3
    robot.run(360, Request.WALK, (0.5, 0.0, 0.0))
    assert robot.far.velocity[0] > 0.3  # [m/s]
    robot.run(1, Request.JUMP_TO, (0.5, 0.1, 0.0))
    run_until(robot, State.JUMP_TO)
    goal = robot.runtime.skill.goal
    run_until(robot, State.WALK)
    assert np.linalg.norm(robot.far.q[:2] - goal) < 0.1  # [m]
    log.close()
    count, first = replay(tmp_path / "log", bundle)
    assert count > 3000 and first == -1
    assert (tmp_path / "log" / "frames.asc").stat().st_size > 1e5  # bytes
    changed = read_log(tmp_path / "log")[0].copy()
    changed["received"]["motor"][1000, 3, 2] ^= 1
    (tmp_path / "log" / "ticks.bin").write_bytes(changed.tobytes())
    assert replay(tmp_path / "log", bundle)[1] >= 1000


@pytest.mark.parametrize(
    ("faults", "tolerance"),
    [
        ({}, 0.03), ({"drop": 0.01}, 0.1), ({"delay": 0.5}, 0.1),
        ({"gyro_noise": 5e-3, "accel_noise": 0.05}, 0.05),
    ],
    ids=["no fault", "1 % of frames lost", "a tick of jitter", "estimator and noise"],
)  # fmt: skip
def test_jump_up_over_the_bus_reaches_its_height(faults, tolerance, make_robot):
    robot = make_robot(BusFaults(**faults), Estimator() if "gyro_noise" in faults else None)
    robot.stand()
    robot.run(1, Request.JUMP_UP, (0.8, 0.0, 0.0))
    assert run_until(robot, State.WALK) == pytest.approx(0.8, abs=tolerance)  # [m]
    robot.run(120)
    assert robot.runtime.state == State.WALK and robot.far.q[2] > 0.2


def test_motors_stay_off_until_the_robot_has_been_at_rest(make_robot):
    """Without motors the standing robot falls, and lies after 0.3 s."""
    robot = make_robot(BusFaults(gyro_noise=0.02, accel_noise=0.2), Estimator())
    robot.run(60)
    robot.run(60, Request.STAND)
    assert robot.runtime.state == State.PASSIVE and robot.runtime.reason == Fault.MOVING
    robot.run(240)
    robot.run(30, Request.STAND)
    assert robot.runtime.state == State.STAND_UP and robot.runtime.reason == Fault.NONE
    assert robot.runtime.estimate.position[2] == pytest.approx(robot.far.q[2], abs=0.03)  # [m]
    robot.run(1, Request.PASSIVE)
    robot.run(1, Request.STAND)
    assert robot.runtime.reason == Fault.MOVING  # earlier readings do not count


def test_every_motor_is_switched_on_although_frames_are_lost(make_robot):
    """With one frame each, 0.9^12 = 28 % of robots would have all motors on."""
    for seed in range(5):
        robot = make_robot(BusFaults(drop=0.1, seed=seed))
        while robot.runtime.state == State.PASSIVE:
            robot.run(1, Request.STAND)
        robot.run(6)
        assert robot.far.enabled.all()


def test_dry_run_keeps_the_motors_off_and_its_log_replays(make_robot, bundle, tmp_path):
    robot = make_robot(dry_run=True)
    log = Log(tmp_path / "log", bundle, 480, capture=True, dry_run=True)
    robot.runtime.listener = log.tick
    records = robot.enable(50)
    assert robot.runtime.state == State.STAND_UP
    assert not robot.far.enabled.any() and (records[-1]["sent"] == robot.runtime.off).all()
    log.close()
    assert replay(tmp_path / "log", bundle)[1] == -1
    with pytest.raises(InputError, match="dry run"):
        motions_of_log(tmp_path / "log")


def log_standing_up(robot, bundle, folder, wait):
    """Write the log of a robot that waits some ticks for the confirmation, and begins to stand up."""
    log = Log(folder, bundle, 480, capture=True)
    robot.runtime.listener = log.tick
    robot.enable(wait)
    robot.run(360, Request.CONFIRM)
    log.close()


def test_motions_of_a_log_have_the_gains_that_were_sent(make_robot, bundle, tmp_path):
    """While the robot waits for the confirmation, it only damps."""
    robot = make_robot()
    log_standing_up(robot, bundle, tmp_path / "log", 480)
    (motion,) = motions_of_log(tmp_path / "log")
    assert len(motion.time) == 360 - 1 and (motion.base, motion.gains, motion.torque_limit) == ("free", "jumping", 18.0)
    given = {"base": "fixed", "gains": "walking", "torque_limit": 12.0}
    (motion,) = motions_of_log(tmp_path / "log", **given)
    assert {name: getattr(motion, name) for name in given} == given
    ticks = read_log(tmp_path / "log")[0]
    sent = np.array([bundle.joints.codec.decode_command(frames)[2] for frames in ticks["sent"][1:]])
    entered = (ticks["sent"][1:, :, :7] == 0xFF).all(axis=(1, 2))  # frames that switch motors
    assert sent[~entered] == pytest.approx(ticks["kp"][:-1][~entered], abs=0.1)


def test_log_is_shown_with_its_simulation_from_the_first_estimate_on(make_robot, bundle, tmp_path, capsys):
    robot = make_robot()
    log_standing_up(robot, bundle, tmp_path / "log", 200)
    ticks = read_log(tmp_path / "log")[0].copy()
    ticks[:240]["position"] = 0.0
    assert simulated_again(ticks[:2], 480)[0, 2] > 0.3  # [m] at the default height
    (tmp_path / "log" / "ticks.bin").write_bytes(ticks.tobytes())
    play_log(LogCfg(tmp_path / "log", tmp_path / "shown"))
    assert capsys.readouterr().out.startswith(f"{(len(ticks) - 240) / 480:.1f} s")


def test_zeroing_makes_the_angle_of_one_joint_its_offset(make_robot):
    robot = make_robot()
    before = robot.run(3)[-1]["angle"]
    robot.run(2, Request.ZERO, (4.0,))
    after = robot.run(2)[-1]["angle"]
    assert robot.runtime.state == State.PASSIVE and robot.far.zero[4] != 0.0
    assert after[4] == pytest.approx(0.0, abs=0.01)  # [rad]
    assert np.delete(after, 4) == pytest.approx(np.delete(before, 4), abs=0.01)


@pytest.mark.parametrize(("follows", "fails"), [(3, False), (None, True), (4, True)])
def test_joint_test_fails_unless_the_joint_alone_follows(follows, fails, bundle):
    test = joint_test(bundle.default, 3, 1.0 / 480.0)
    q, largest = bundle.default.copy(), 0.0
    while not test.done:
        target = test.step(SimpleNamespace(q=q, gravity=np.zeros(3)))
        largest = max(largest, target[3])
        q = bundle.default.copy()
        if follows is not None:
            q[follows] += target[3] - bundle.default[3]
    assert test.failed == fails
    assert largest - bundle.default[3] == pytest.approx(0.15)  # [rad]
    assert target == pytest.approx(bundle.default)


def test_joint_of_a_request_moves(make_robot):
    robot = make_robot()
    robot.stand()
    targets = np.array([record["target"] for record in robot.run(150, Request.JOINT, (4.0,))])
    assert np.flatnonzero(np.ptp(targets, axis=0) > 0.1).tolist() == [4]


def test_policy_acts_every_eighth_or_ninth_tick_at_500_hz(make_robot):
    robot = make_robot(rate=500)
    robot.stand()
    robot.run(1, Request.WALK)
    acted = []
    targets = robot.runtime.skill.targets
    robot.runtime.skill.targets = lambda motion: acted.append(tick) or targets(motion)
    for tick in range(100):  # noqa: B007
        robot.run(1)
    assert set(np.diff(acted)) == {8, 9} and len(acted) == 12


def test_ticks_that_a_late_one_drops_count_for_policy_and_estimator(make_robot):
    """One tick is late by two: the policy acts in the eighth tick of time, which is the sixth that ran."""
    spans, acted = [], []

    class Source(MotionCapture):
        def update(self, *readings):
            spans.append(readings[-1])
            return super().update(*readings)

    robot = make_robot(source=Source())
    robot.stand()
    robot.run(1, Request.WALK)
    targets = robot.runtime.skill.targets
    robot.runtime.skill.targets = lambda motion: acted.append(tick) or targets(motion)
    del spans[:]
    for tick, late in enumerate([0.1, 0.2, 2.3, 0.4, -0.2, 0.0, 0.0], 1):  # noqa: B007
        robot.run(1, late=late / 480.0)
    assert np.multiply(spans, 480.0) == pytest.approx([1, 1, 3, 1, 1, 1, 1])
    assert acted == [6]


def test_skill_begins_at_rest_for_0_3_s_with_the_action_of_the_present_targets(make_robot, bundle):
    robot = make_robot()
    robot.stand()
    motion = robot.runtime.motion
    motion.stood = 0.0
    rests = [robot.run(1) and motion.at_rest for _ in range(200)]
    assert rests.index(True) == pytest.approx(144, abs=2)  # ticks
    target = bundle.default + np.float32(0.1)
    for state, speed in ((State.WALK, None), (State.JUMP_UP, 0.75), (State.JUMP_TO, 0.25)):
        skill = robot.runtime.skills[state]
        skill.begin(np.zeros(3), motion, target)
        assert skill.policy.default + skill.policy.scale * skill.policy.action == pytest.approx(target)
        assert speed is None or skill.phase._takeoff_speed == speed  # [m/s]

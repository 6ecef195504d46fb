"""Each fault injected over the bus: how many ticks until it is detected, and what the motors do."""

import copy
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import can
import numpy as np
import pytest

from jumper_warp.bench.bus_sim import BusFaults
from jumper_warp.deploy.bus import Link
from jumper_warp.deploy.runtime import Request, State
from jumper_warp.deploy.safety import HOLD_TICKS, Fault
from jumper_warp.deploy.sensors import MAX_AGE
from jumper_warp.deploy.watchdog import Watchdog, brake
from jumper_warp.utils.errors import InputError


class OffBus:
    """Bus that cannot send."""

    def __init__(self, bus):
        self.bus = bus

    def send(self, message):
        """Raise the error of a bus that is off; the far end still gets the end of the tick."""
        if message.arbitration_id == 0x7FE:
            self.bus.send(message)
        else:
            raise can.CanOperationError("bus off")

    def __getattr__(self, name):
        return getattr(self.bus, name)


def tilt(robot):
    """Turn the robot on its side."""
    q = robot.far.sim.state.joint_q.numpy()
    q[2:7] = [0.6, np.sin(0.75), 0.0, 0.0, np.cos(0.75)]
    robot.far.sim.state.joint_q.assign(q)


def nan_action(robot):
    """Let the policy return NaN."""
    skill = robot.runtime.skill
    skill.policy = copy.copy(skill.policy)  # the bundle is shared
    skill.policy._session = SimpleNamespace(run=lambda *inputs: [np.full((1, 12), np.nan, np.float32)])


def diverge(robot):
    """Let the state source diverge."""
    source = robot.runtime.source
    source.update = lambda *readings: source._estimate._replace(diverged=True)


def silence_capture(robot):
    """Let the motion capture send nothing more."""
    sensors = robot.far.sensors
    robot.far.sensors = lambda: sensors()[:2]


def reports(row, motor, value):
    """Return a function that adds a value to the replies of a motor: 0 angle [rad], 1 rate [rad/s], 2 torque [N m]."""
    return lambda robot: robot.far.bias.__setitem__((row, motor), value)


def of_faults(**values):
    """Return a function that sets values of `BusFaults`."""
    return lambda robot: vars(robot.far.faults).update(values)


FAULTS = {
    # name: injection, fault, ticks from the first one with the fault to damping, arguments of the tick
    "motor silent": (lambda robot: robot.far.silent.add(4), Fault.SILENT, 5, {}),
    "bus off": (lambda r: r.link.buses.__setitem__(1, OffBus(r.link.buses[1])), Fault.BUS_OFF, 5, {}),
    "error frames": (of_faults(corrupt=1.0), Fault.ERROR_FRAME, 5, {}),
    "over-temperature": (of_faults(temperature=95.0), Fault.TEMPERATURE, 1, {}),
    "motor error": (of_faults(error_code=2), Fault.MOTOR_ERROR, 1, {}),
    "torque": (reports(2, 5, 25.0), Fault.TORQUE, 5, {}),
    "speed": (reports(1, 5, 50.0), Fault.SPEED, 1, {}),
    "position": (reports(0, 6, 3.0), Fault.POSITION, 1, {}),
    "tilt": (tilt, Fault.TILT, 2, {}),  # the state is a tick old
    "stale IMU": (lambda r: setattr(r.far, "imu_frozen", True), Fault.STALE, 6, {}),  # the first frozen counter is new
    "diverged estimate": (diverge, Fault.DIVERGED, 5, {}),
    "silent motion capture": (silence_capture, Fault.DIVERGED, MAX_AGE + 5, {}),
    "NaN of the policy": (nan_action, Fault.NOT_FINITE, 5 + 8, {}),  # the policy acts every eighth tick
    "late ticks": (of_faults(), Fault.LATE, 5, {"late": 2.0e-3}),
    "a tick 20 ms late": (of_faults(), Fault.LATE, 1, {"late": 0.02}),
    "operator's stop": (of_faults(), Fault.STOP, 1, {"request": Request.STOP}),
    "wrong firmware id": (of_faults(motor_own_id=True), Fault.WRONG_ID, 1, {}),
}


@pytest.mark.parametrize("name", FAULTS)
def test_fault_ends_in_damping(name, make_robot):
    inject, fault, ticks, arguments = FAULTS[name]
    robot = make_robot()
    robot.stand()
    robot.run(24, Request.WALK, (0.3, 0.0, 0.0))
    assert robot.runtime.state == State.WALK
    before = robot.runtime.frames.copy()
    inject(robot)
    records = [*robot.run(ticks + 3, **arguments)]
    states = [State(int(record["state"])) for record in records]
    damped = states.index(State.DAMP) + 1
    assert damped <= ticks, (damped, states)
    assert robot.runtime.reason == fault
    assert Fault(int(records[-1]["fault"])) == fault
    faulty = [record for record in records[: damped - 1] if record["fault"]]
    assert len(faulty) <= HOLD_TICKS
    if len(faulty) == HOLD_TICKS and name not in ("NaN of the policy", "stale IMU", "silent motion capture"):
        assert (records[2]["sent"] == before).all()  # the last safe target
    kp = robot.runtime.bundle.joints.codec.decode_command(robot.runtime.frames)[2]
    assert (kp == 0.0).all()


@pytest.mark.parametrize("name", ["motor silent", "stale IMU", "operator's stop", "over-temperature"])
def test_fault_in_flight_ends_in_damping_after_touchdown(name, make_robot):
    inject, fault, _, arguments = FAULTS[name]
    robot = make_robot()
    robot.stand()
    robot.run(1, Request.JUMP_UP, (0.8, 0.0, 0.0))
    while robot.far.contact.any() or robot.far.velocity[2] < 0.5:
        robot.run(1)
    inject(robot)
    records = robot.run(360, **arguments)
    states = [int(record["state"]) for record in records]
    touchdown = next(i for i, record in enumerate(records) if i > 20 and record["contact"].any())
    assert states.count(State.LANDING) > 50
    first = states.index(State.DAMP)
    assert touchdown - 30 <= first <= touchdown + 30
    landing = records[states.index(State.LANDING) + 1]
    assert (landing["target"] == robot.runtime.bundle.default).all()
    assert robot.runtime.reason == fault


def test_swapped_cables_fail_the_sign_test(make_robot):
    for legs, fails in (([0, 1, 2, 3], False), ([1, 0, 2, 3], True), ([2, 1, 0, 3], True)):
        robot = make_robot()
        robot.far.legs = legs
        robot.stand()
        records = robot.run(1, Request.CONFIRM)
        while robot.runtime.state == State.HOLD and not robot.runtime._procedure.done:
            records += robot.run(1)
        assert (robot.runtime.reason == Fault.SIGN) == fails, legs
        assert robot.runtime.state == (State.DAMP if fails else State.HOLD)


def test_request_in_a_tick_with_a_fault_is_kept(make_robot):
    """Two lost replies of a motor are a fault; a velocity that the operator requests then is commanded after it."""
    robot = make_robot()
    robot.stand()
    robot.run(24, Request.WALK, (0.3, 0.0, 0.0))
    robot.far.silent = {4}
    robot.run(1)
    robot.run(1, Request.WALK, (0.5, 0.0, 0.2))
    assert robot.runtime.safety.fault == Fault.SILENT
    robot.far.silent = set()
    robot.run(1)
    assert robot.runtime.state == State.WALK
    assert robot.runtime.skill.wanted == pytest.approx([0.5, 0.0, 0.2])


def test_wrong_firmware_keeps_the_motors_off(make_robot):
    robot = make_robot(BusFaults(motor_own_id=True))
    robot.run(5)
    robot.run(2, Request.STAND)
    assert robot.runtime.state == State.PASSIVE and not robot.runtime.ready


WATCHED = """
import sys, time
from jumper_warp.deploy.bundle import Bundle
from jumper_warp.deploy.watchdog import Watchdog
dog = Watchdog(sys.argv[2], Bundle(sys.argv[1]).settings, silence=1e6, damping_time=0.02)
dog.beat()
print(dog.process.pid, flush=True)
time.sleep(1e6)
"""


def test_watchdog_brakes_and_switches_off_when_the_runtime_is_killed(make_robot, bundle_folder, tmp_path):
    robot = make_robot()
    robot.stand()
    process = subprocess.Popen(
        [sys.executable, "-c", WATCHED, str(bundle_folder), f"unix:{tmp_path}"], stdout=subprocess.PIPE, text=True
    )
    dog = int(process.stdout.readline())
    process.send_signal(signal.SIGKILL)
    process.wait()
    first = [bus.recv(60.0) for bus in robot.far.buses]
    os.kill(dog, signal.SIGKILL)
    for message in first:
        frames = np.array([list(message.data)] * 12, dtype=np.uint8)
        _, _, kp, kd, _ = robot.far.codec.decode_command(frames)
        assert (kp == 0.0).all() and kd == pytest.approx(2.0, abs=1e-3)


def test_watch_begins_with_the_first_tick_and_its_end_is_reported(bundle, make_robot, tmp_path):
    make_robot()
    dog = Watchdog(f"unix:{tmp_path}", bundle.settings, silence=0.02, damping_time=0.02)
    time.sleep(0.5)
    assert dog.process.is_alive()
    dog.beat()
    dog.process.join(60.0)
    assert dog.process.exitcode == 0
    with pytest.raises(InputError, match="the watchdog has switched the motors off"):
        dog.beat()
    dog.close()


def test_braking_damps_the_motors_then_switches_them_off(make_robot, bundle):
    robot = make_robot()
    robot.stand()
    modes = []

    def sleep(seconds):
        for number, bus in enumerate(robot.far.buses):
            while (message := bus.recv(0.0)) is not None:
                robot.far.answer(number, message)
        robot.far.advance()
        modes.append(robot.far.enabled.all())
        time.sleep(0.05)

    brake(Link(robot.link.buses), bundle.settings, 0.2, sleep)
    assert 1 <= len(modes) - 3 <= 4 and modes == [True] * (len(modes) - 3) + [False] * 3

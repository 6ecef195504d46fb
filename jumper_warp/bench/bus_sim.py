"""Simulated far end of the buses: the robot as twelve motors, an IMU and a motion capture, with the robot's frames.

Each motor has the described torque-speed curve and no torque limit of a controller, as the firmware in MIT mode. It
replies to a command with its state at that time, and follows the command until the next one.
"""

from __future__ import annotations

from collections.abc import Sequence

import can
import numpy as np

from jumper_warp.bench.faults import BusFaults
from jumper_warp.deploy.bus import LEGS, LOCKSTEP_TIMEOUT, MOTORS, SYNC, data_frame
from jumper_warp.deploy.codec import ENTER, EXIT, HOST_ID, ZERO, Codec, Reply
from jumper_warp.deploy.sensors import SENSOR_IDS, pack_capture, pack_imu
from jumper_warp.deploy.skills import rotate
from jumper_warp.robot.description import load_description
from jumper_warp.robot.gravity import EARTH
from jumper_warp.robot.motors import jumping_motors
from jumper_warp.sim.simulation import Simulation, motor_values

CONTACT_FORCE = 0.1  # [N] of a paw that is down


def make_simulation(dt: float, friction: float = 0.85) -> Simulation:
    """Return the simulation of a robot whose motors have no torque limit but their own; dt: physics step [s]."""
    motors = jumping_motors(100.0)  # cut to the motors' peak torque
    return Simulation(1, motors=motors, friction=friction, dt=dt, substeps=1, device="cpu", visuals=False)


class BusSim:
    """Far end of four buses; `serve` answers the frames of a tick in lockstep, `answer` and `advance` do so apart."""

    def __init__(self, buses: Sequence[can.BusABC], faults: BusFaults | None = None, *, sim: Simulation) -> None:
        """Start standing in the default pose; sim: of `make_simulation`, with a physics step a tick."""
        self.buses = list(buses)
        self.faults = BusFaults() if faults is None else faults
        self.dt = sim.dt
        self.sim = sim
        self.codec = Codec([motor.type for motor in load_description().motors])
        self.rng = np.random.default_rng(self.faults.seed)
        self.zero = np.zeros(12)  # [rad] position of each motor at its zero
        self.silent: set[int] = set()  # motors that do not reply
        self.bias = np.zeros((3, 12))  # added to position [rad], speed [rad/s] and torque [N m] in replies
        self.imu_bias = np.zeros((2, 3))  # added to angular velocity [rad/s] and specific force [m/s^2]
        self.imu_frozen = False
        self.legs = list(range(LEGS))  # leg at each bus: a permutation swaps cables
        self.count = 0
        self.largest_torque = np.zeros(12)  # [N m] delivered by each motor so far
        self.restart()

    def restart(self) -> None:
        """Stand in the default pose, with motors off."""
        self.sim.reset()
        self.enabled = np.zeros(12, bool)
        self.command = np.zeros((12, 8), np.uint8)  # newest command frame of each motor
        self._late: list[tuple[int, bytes]] = []
        self.velocity = np.zeros(3)
        self._read()

    def _read(self) -> None:
        """Read the state of the simulation."""
        sim = self.sim
        self._replies: np.ndarray | None = None  # of the present state, once a motor has replied
        self.q, self.qd = sim.joint_q()[0].copy(), sim.joint_qd()[0].copy()
        self.angle, self.rate = motor_values(self.q[7:]).astype(float), motor_values(self.qd[6:]).astype(float)
        self.torque = sim.torque.numpy()[:, 0].astype(float)
        velocity = sim.base_velocity()[0].astype(float)
        self.acceleration = (velocity - self.velocity) / self.dt
        self.velocity = velocity
        self.contact = np.linalg.norm(sim.paw_force.numpy()[:, 0], axis=-1) > CONTACT_FORCE

    def serve(self) -> bool:
        """Answer the frames of a tick in lockstep, which end with SYNC on each bus, and advance the simulation.

        Returns False if the runtime has ended.
        """
        late, self._late = self._late, []
        for motor, data in late:
            self.take(motor, data)
        answers: list[list[can.Message]] = [[] for _ in range(LEGS)]
        for number, bus in enumerate(self.buses):
            while (message := bus.recv(LOCKSTEP_TIMEOUT)) is not None and message.arbitration_id != SYNC:
                answers[number] += self.answer(number, message)
            if message is None:
                return False
        answers[0] += self.sensors()
        for number, bus in enumerate(self.buses):
            for message in answers[number]:
                self.send(bus, message)
            bus.send(data_frame(SYNC, b""))
        self.advance()
        return True

    def answer(self, number: int, message: can.Message) -> list[can.Message]:
        """Take a command on a bus, and return the motor's reply."""
        own_id = message.arbitration_id
        motor = MOTORS * self.legs[number] + own_id - 1
        if not 1 <= own_id <= MOTORS or motor in self.silent or self._lost():
            return []
        data = bytes(message.data)
        if self.faults.delay and self.rng.random() < self.faults.delay:
            self._late.append((motor, data))
        else:
            self.take(motor, data)
        return [data_frame(own_id if self.faults.motor_own_id else HOST_ID, self.replies()[motor].tobytes())]

    def replies(self) -> np.ndarray:
        """Return the motors' replies in the present state, (12, 8) uint8."""
        if self._replies is None:
            position, velocity, torque = self.bias + [self.angle - self.zero, self.rate, self.torque]
            error = np.array([self.faults.error_code] + 11 * [0])
            reply = Reply(position, velocity, torque, np.full(12, self.faults.temperature), error)
            self._replies = self.codec.encode_reply(np.tile([1, 2, 3], LEGS), reply)
        return self._replies

    def take(self, motor: int, data: bytes) -> None:
        """Store a motor's command, or switch it."""
        if data in (ENTER, EXIT):
            self.enabled[motor] = data == ENTER
            self.command[motor] = 0
        elif data == ZERO:
            self.zero[motor] = self.angle[motor]
        else:
            self.command[motor] = np.frombuffer(data, np.uint8)

    def sensors(self) -> list[can.Message]:
        """Return the frames of IMU and motion capture."""
        self.count += not self.imu_frozen
        force = rotate(self.q[3:7], self.acceleration + np.array([0.0, 0.0, EARTH]), inverse=True)
        gyro = rotate(self.q[3:7], self.qd[3:6], inverse=True)
        deviations = np.array([[self.faults.gyro_noise], [self.faults.accel_noise]])
        gyro, force = self.imu_bias + [gyro, force] + deviations * self.rng.normal(size=(2, 3))
        frames = [
            *pack_imu(gyro, force, self.count),
            *pack_capture(self.q[:3], self.velocity, self.q[3:7], self.contact),
        ]
        return [data_frame(number, data) for number, data in zip(SENSOR_IDS, frames, strict=True)]

    def _lost(self) -> bool:
        """Return whether a frame is lost."""
        return bool(self.faults.drop) and self.rng.random() < self.faults.drop

    def send(self, bus: can.BusABC, message: can.Message) -> None:
        """Send a frame unless it is lost; a corrupt one arrives as an error frame."""
        if self._lost():
            return
        if self.faults.corrupt and self.rng.random() < self.faults.corrupt:
            message = can.Message(is_error_frame=True, is_extended_id=False)
        bus.send(message)

    def advance(self) -> None:
        """Advance the simulation by a tick with the motors' present commands."""
        position, velocity, kp, kd, feedforward = self.codec.decode_command(self.command)
        motors = self.sim.motors
        motors.kp.numpy()[:, 0] = self.enabled * kp
        motors.kd.numpy()[:, 0] = self.enabled * kd
        ahead = np.divide(kd * velocity + feedforward, kp, out=np.zeros(12), where=kp > 0.0)
        self.sim.target.numpy()[:, 0] = position + self.zero + ahead
        self.sim.filter_targets()  # none: the targets pass
        self.sim.physics_step()
        self._read()
        self.largest_torque = np.maximum(self.largest_torque, np.abs(self.torque))

"""Simulated far end of the buses: the robot as twelve motors, an IMU and a motion capture, with the robot's frames.

Each motor has the described torque-speed curve and no torque limit of a controller, as the firmware in MIT mode. It
replies to a command with its state at that time, and follows the command until the next one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import can
import numpy as np

from jumper_warp.deploy.bus import LEGS, LOCKSTEP_TIMEOUT, MOTORS, SYNC
from jumper_warp.deploy.codec import ENTER, EXIT, HOST_ID, ZERO, Codec, Reply
from jumper_warp.deploy.sensors import (
    ACCEL_SCALE,
    GYRO_SCALE,
    LENGTH_SCALE,
    SENSOR_IDS,
    SPEED_SCALE,
    pack_attitude,
    pack_imu,
    pack_vector,
)
from jumper_warp.deploy.skills import rotate
from jumper_warp.robot.description import load_description
from jumper_warp.robot.gravity import EARTH
from jumper_warp.robot.motors import jumping_motors
from jumper_warp.sim.simulation import Simulation, motor_values

CONTACT_FORCE = 0.1  # [N] of a paw that is down


@dataclass
class BusFaults:
    """Faults of buses and motors, which may change at any time."""

    drop: float = 0.0  # Probability that a frame is lost
    corrupt: float = 0.0  # Probability that a frame arrives as an error frame
    delay: float = 0.0  # Probability that a motor gets its command, and replies, a tick late
    temperature: float = 35.0  # [°C] of all motors
    motor_own_id: bool = False  # Motors reply under their own id
    seed: int = 0


def make_simulation(dt: float, friction: float = 0.85) -> Simulation:
    """Return the simulation of a robot whose motors have no torque limit but their own; dt: physics step [s]."""
    motors = jumping_motors(100.0)  # cut to the motors' peak torque
    return Simulation(1, motors=motors, friction=friction, dt=dt, substeps=1, device="cpu", visuals=False)


class BusSim:
    """Far end of four buses; `serve` answers the frames of a tick in lockstep, `answer` and `advance` do so apart."""

    def __init__(
        self, buses: Sequence[can.BusABC], faults: BusFaults | None = None, *, rate: int = 480, friction: float = 0.85,
        simulation: Simulation | None = None,
    ) -> None:  # fmt: skip
        """Start standing in the default pose; rate: ticks a second, a physics step each; friction: of the paws."""
        self.buses = list(buses)
        self.faults = BusFaults() if faults is None else faults
        self.dt = 1.0 / rate
        self.sim = simulation or make_simulation(self.dt, friction)
        self.codec = Codec([motor.type for motor in load_description().motors])
        self.rng = np.random.default_rng(self.faults.seed)
        self.command = np.zeros((12, 8), np.uint8)  # newest command frame of each motor
        self.enabled = np.zeros(12, bool)
        self.zero = np.zeros(12)  # [rad] position of each motor at its zero
        self.silent: set[int] = set()  # motors that do not reply
        self.error_code = np.zeros(12, int)
        self.torque_bias = np.zeros(12)  # [N m] added to the torque in replies
        self.speed_bias = np.zeros(12)  # [rad/s] added to the speed in replies
        self.position_bias = np.zeros(12)  # [rad] added to the position in replies
        self.imu_frozen = False
        self.capture_lost = False
        self.legs = list(range(LEGS))  # leg at each bus: a permutation swaps cables
        self.count = 0
        self.largest_torque = np.zeros(12)  # [N m] delivered by each motor so far
        self.gyro_noise = self.accel_noise = 0.0
        self._late: list[tuple[int, bytes]] = []
        self._velocity = np.zeros(3)
        self._read()

    def restart(self) -> None:
        """Stand in the default pose again, with motors off."""
        self.sim.reset()
        self.enabled[:] = False
        self.command[:] = 0
        self._late = []
        self._velocity = np.zeros(3)
        self._read()

    def _read(self) -> None:
        """Read the state of the simulation."""
        sim = self.sim
        self._replies: np.ndarray | None = None  # of the present state, once a motor has replied
        self.q, self.qd = sim.joint_q()[0].copy(), sim.joint_qd()[0].copy()
        self.angle, self.rate = motor_values(self.q[7:]).astype(float), motor_values(self.qd[6:]).astype(float)
        self.torque = sim.torque.numpy()[:, 0].astype(float)
        velocity = sim.base_velocity()[0].astype(float)
        self.acceleration = (velocity - self._velocity) / self.dt
        self._velocity = velocity
        self.contact = np.linalg.norm(sim.paw_force.numpy()[:, 0], axis=-1) > CONTACT_FORCE

    def serve(self) -> bool:
        """Answer the frames of a tick in lockstep, which end with SYNC on each bus, and advance the simulation.

        Returns False if the runtime has ended.
        """
        late, self._late = self._late, []
        for motor, data in late:
            self._take(motor, data)
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
            bus.send(can.Message(arbitration_id=SYNC, is_extended_id=False))
        self.advance()
        return True

    def answer(self, number: int, message: can.Message) -> list[can.Message]:
        """Take a command on a bus, and return the motor's reply."""
        motor = MOTORS * self.legs[number] + message.arbitration_id - 1
        if not 1 <= message.arbitration_id <= MOTORS or motor in self.silent or self._lost():
            return []
        data = bytes(message.data)
        if self.faults.delay and self.rng.random() < self.faults.delay:
            self._late.append((motor, data))
            return [self._reply(motor, message.arbitration_id)]
        self._take(motor, data)
        return [self._reply(motor, message.arbitration_id)]

    def _take(self, motor: int, data: bytes) -> None:
        """Store a motor's command, or switch it."""
        if data in (ENTER, EXIT):
            self.enabled[motor] = data == ENTER
            self.command[motor] = 0
        elif data == ZERO:
            self.zero[motor] = self.angle[motor]
        else:
            self.command[motor] = np.frombuffer(data, np.uint8)

    def _reply(self, motor: int, own_id: int) -> can.Message:
        """Return the reply of a motor."""
        if self._replies is None:
            reply = Reply(
                self.angle - self.zero + self.position_bias,
                self.rate + self.speed_bias,
                self.torque + self.torque_bias,
                np.full(12, self.faults.temperature),
                self.error_code,
            )
            self._replies = self.codec.encode_reply(np.tile([1, 2, 3], LEGS), reply)
        arbitration_id = own_id if self.faults.motor_own_id else HOST_ID
        return can.Message(arbitration_id=arbitration_id, data=self._replies[motor].tobytes(), is_extended_id=False)

    def sensors(self) -> list[can.Message]:
        """Return the frames of IMU and motion capture."""
        self.count += not self.imu_frozen
        force = rotate(self.q[3:7], self.acceleration + np.array([0.0, 0.0, EARTH]), inverse=True)
        gyro = rotate(self.q[3:7], self.qd[3:6], inverse=True)
        force = force + self._noise(self.accel_noise)
        gyro = gyro + self._noise(self.gyro_noise)
        frames = [pack_imu(gyro, GYRO_SCALE, self.count), pack_imu(force, ACCEL_SCALE, self.count)]
        if not self.capture_lost:
            frames += [
                pack_vector(self.q[:3], LENGTH_SCALE),
                pack_vector(self._velocity, SPEED_SCALE),
                pack_attitude(self.q[3:7], self.contact),
            ]
        ids = SENSOR_IDS[: len(frames)]
        return [can.Message(arbitration_id=i, data=d, is_extended_id=False) for i, d in zip(ids, frames, strict=True)]

    def _noise(self, std: float) -> np.ndarray:
        """Return noise (3,) of a standard deviation."""
        return self.rng.normal(0.0, std, 3) if std else np.zeros(3)

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
        on = self.enabled.astype(float)
        motors = self.sim.motors
        motors.kp.assign((on * kp)[:, None].astype(np.float32))
        motors.kd.assign((on * kd)[:, None].astype(np.float32))
        ahead = np.divide(kd * velocity + feedforward, kp, out=np.zeros(12), where=kp > 0.0)
        self.sim.target.assign((position + self.zero + ahead)[:, None].astype(np.float32))
        self.sim.filter_targets()  # none: the targets pass
        self.sim.physics_step()
        self._read()
        self.largest_torque = np.maximum(self.largest_torque, np.abs(self.torque))

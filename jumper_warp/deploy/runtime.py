"""Runtime of the robot: a state machine that turns a tick's frames into the frames of the next commands.

`Runtime.tick` sends the frames that the last tick computed, collects the replies, and computes the next frames. It
depends on nothing but its arguments and the received frames, so that a log replays bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntEnum
from typing import Any

import numpy as np

from jumper_warp.deploy.bundle import Bundle
from jumper_warp.deploy.bus import RECEIVED, Link
from jumper_warp.deploy.codec import ENTER, EXIT, ZERO
from jumper_warp.deploy.control import Gains, clip_target, motor_torque
from jumper_warp.deploy.estimator import Estimator, EstimatorCfg
from jumper_warp.deploy.motions import BallisticLanding, Ramp, joint_test, sign_test
from jumper_warp.deploy.safety import Fault, Safety
from jumper_warp.deploy.sensors import UNKNOWN, MotionCapture, unpack_imu
from jumper_warp.deploy.skills import Jump, Motion, Skill, Walk
from jumper_warp.utils.errors import InputError

State = IntEnum("State", "PASSIVE STAND_UP HOLD WALK JUMP_UP JUMP_TO DAMP LANDING", start=0)
"""States of the robot. PASSIVE: motors off; STAND_UP: from any lying pose, after a confirmation; HOLD: stand in the
default pose; DAMP: motors brake; LANDING: a fault in flight, the landing pose until touchdown."""
Request = IntEnum("Request", "NONE PASSIVE STAND CONFIRM HOLD WALK JUMP_UP JUMP_TO STOP ZERO JOINT", start=0)
"""Requests of the operator. STAND enables the motors of a robot at rest, which brake; CONFIRM stands up, and in HOLD
tests legs' signs. ZERO makes the present angle of a joint, values[0], its zero, in PASSIVE; JOINT moves a joint, in
HOLD on a stand."""
NO_REQUEST: tuple[Request, Any] = (Request.NONE, ())
SKILLS = {"walk": (State.WALK, Walk), "jump_up": (State.JUMP_UP, Jump), "jump_to": (State.JUMP_TO, Jump)}
JUMPS = (State.JUMP_UP, State.JUMP_TO)
JUMP_OF_REQUEST = {Request.JUMP_UP: State.JUMP_UP, Request.JUMP_TO: State.JUMP_TO}
DRIVERLESS = (State.PASSIVE, State.DAMP, State.LANDING)  # states that a fault does not end
RATES = (480, 500)  # [Hz] ticks a second
ENTER_TICKS = 5  # in each of which the motors are switched on, since a frame can be lost
REST_TICKS = 96  # over which the readings of a robot at rest are averaged
REST_RATE = 0.2  # [rad/s] largest reading of gyro and motor rates at rest; noise of 0.02 rad/s reaches 0.1
CLOCK = 240_000  # units of time a second, in which policy steps and ticks of 480 and 500 Hz are whole numbers
TICK = np.dtype([
    ("received", RECEIVED), ("late", "f4"), ("request", "i1"), ("values", "f4", 3), ("sent", "u1", (12, 8)),
    ("state", "i1"), ("fault", "i1"), ("fault_ticks", "i2"), ("target", "f4", 12), ("kp", "f4", 12),
    ("angle", "f4", 12), ("rate", "f4", 12), ("torque", "f4", 12), ("position", "f4", 3),
    ("velocity", "f4", 3), ("quaternion", "f4", 4),
    ("contact", "?", 4),
])  # fmt: skip
"""Record of a tick: what `Runtime.tick` received, what it sent before, and what it derived."""


class Runtime:
    """State machine, policies, safety and motor commands of one robot."""

    def __init__(
        self, bundle: Bundle, link: Link, source: Estimator | MotionCapture | None = None, *,
        rate: int = 480, dry_run: bool = False,
    ) -> None:  # fmt: skip
        """Start in PASSIVE.

        source: of the base's state; None: an estimator with the bundle's settings. rate: ticks a second. dry_run:
        compute commands, and send frames that switch the motors off.
        """
        settings = bundle.settings
        self.bundle, self.link = bundle, link
        self.source = Estimator(EstimatorCfg(**settings["estimator"])) if source is None else source
        self.dt, self.dry_run = 1.0 / rate, dry_run
        self.listener: Callable[[np.ndarray], Any] | None = None  # called with the record of every tick
        self.safety = Safety(settings["safety"], settings["closed_chain"]["transversal_sum"])
        self.motion = Motion(settings["switch"], self.dt)
        folded = np.array(settings["stand_up"]["folded"], np.float32).reshape(12)
        self._stand_up = ([folded, bundle.default], float(settings["stand_up"]["seconds"]))
        self.skills: dict[State, Skill] = {}
        for name, policy in bundle.policies.items():
            fields = settings["policies"][name]
            state, kind = SKILLS[fields["skill"]]
            self.skills[state] = kind(policy, Gains.from_yaml(fields), fields["commands"])
        self.damping = np.array(settings["safety"]["damping"], dtype=np.float32)
        self.off, self.enter = (np.tile(np.frombuffer(frame, np.uint8), (12, 1)) for frame in (EXIT, ENTER))
        self.frames = self.off
        self.state, self.reason = State.PASSIVE, Fault.NONE
        self.ready = False  # whether all motors and the IMU have sent frames
        self.record, self.estimate = np.zeros((), TICK), UNKNOWN
        self.pending: tuple[State, np.ndarray] | None = None  # jump that waits until walking has come to rest
        self._request = NO_REQUEST  # of a tick with a fault
        self._procedure: Any = None
        self._target = bundle.default.copy()
        self._gains = bundle.hold
        self._driven = (self._target, 0.0 * self.damping, 0.0 * self.damping)  # target, kp, kd of the next frames
        self._asked = np.zeros(12)  # [N m] torque that the last frames asked for
        self._contact = np.zeros(4, bool)
        self._enter_ticks = 0  # ticks for which the motors are still to be switched on
        self._rest, self._rest_ticks = np.zeros(18), 0  # mean of gyro, accelerometer and angles at rest in PASSIVE
        self.source.reset(np.zeros(3), np.array([0.0, 0.0, 1.0]), bundle.default)  # until the robot rests
        self._time, self._due = 0, 0  # of the tick, and of the next policy step
        self._step, self._policy_step = CLOCK // rate, CLOCK // 60
        self._imu_count, self._finite = -1, True

    def tick(self, request: Request = Request.NONE, values: Any = (), late: float = 0.0) -> np.ndarray:
        """Exchange the frames of a tick, compute the next commands, and return the tick's record (of TICK).

        request, values: of the operator, up to three. late: delay of the tick's begin [s].
        """
        record = self.record
        record["sent"] = self.off if self.dry_run else self.frames
        self.link.send(record["sent"])
        record["received"] = self.link.collect()
        record["late"], record["request"] = late, request
        record["values"] = [*values, 0.0, 0.0, 0.0][:3] if len(values) else 0.0
        self.frames = self._next(record)
        self._time += self._step
        if self.listener is not None:
            self.listener(record)
        return record

    def _next(self, record: np.ndarray) -> np.ndarray:
        """Return the next frames from a record's received frames, request and lateness; fill its other fields."""
        self._read(record)
        request, values = Request(int(record["request"])), record["values"].astype(float)
        ends = self._check(record, request)
        if self.state == State.PASSIVE:
            frames = self._passive(request, values)
        elif ends and self.state not in DRIVERLESS:
            flies = self.state in JUMPS and not self._contact.any()
            self.reason = self.safety.fault
            self._enter(State.LANDING if flies else State.DAMP)
            frames = self._commands()
        elif self.safety.fault and self.state not in DRIVERLESS:
            frames = self.frames  # the last safe target
            self._request = (request, values) if request else self._request
        else:
            self._requests(*((request, values) if request else self._request))
            self._request = NO_REQUEST
            self._act()
            frames = self._commands()
        record["state"], record["target"] = self.state, self._target
        record["fault"], record["fault_ticks"] = self.safety.fault or self.reason, self.safety.ticks
        record["kp"] = self._driven[1]
        return frames

    def _read(self, record: np.ndarray) -> None:
        """Decode the received frames and update the state of the base."""
        received = record["received"]
        self.q, self.qd, self.torque, self.temperature, self.error = self.bundle.joints.read(received["motor"])
        self.gyro, self.accel, count = unpack_imu(received["sensor"][:2])
        self.stale = not received["sensor_fresh"][:2].all() or count == self._imu_count
        self._imu_count = count
        self.ready |= bool(received["motor_fresh"].all() and not self.stale)
        if self.ready and self.state == State.PASSIVE:
            moves = max(np.abs(self.gyro).max(), np.abs(self.qd).max()) > REST_RATE
            self._rest_ticks = 0 if moves else min(self._rest_ticks + 1, REST_TICKS)
            self._rest += (np.concatenate([self.gyro, self.accel, self.q]) - self._rest) / max(1, self._rest_ticks)
            if self._rest_ticks == 1 or (record["request"] == Request.STAND and not moves):
                self.source.reset(self._rest[:3], self._rest[3:6], self._rest[6:])
        dropped = round(float(record["late"]) / self.dt)  # ticks before this one, see `run_loop`
        self._time += dropped * self._step
        if self.ready:
            if received["sensor_fresh"][2:].all():
                self.source.receive(received["sensor"][2:])
            passed = (1 + dropped) * self.dt
            self.estimate = self.source.update(self.gyro, self.accel, self.q, self.qd, self.torque, passed)
        if not self.estimate.diverged:
            self._contact = self.estimate.contact
        record["angle"], record["rate"], record["torque"] = self.q, self.qd, self.torque
        for name in ("position", "velocity", "quaternion", "contact"):
            record[name] = getattr(self.estimate, name)

    def _check(self, record: np.ndarray, request: Request) -> bool:
        """Check the tick for faults, and return whether the policy must end."""
        self.motion.update(self.estimate, self.gyro, self.q, self.qd)
        flies = not self._contact.any() and self.state in JUMPS
        lies = self.state in (State.STAND_UP, State.PASSIVE)
        tilt = 0.0 if lies or flies else math.acos(max(-1.0, min(1.0, -float(self.motion.gravity[2]))))
        limit = np.maximum(self._gains.limit, np.abs(self._asked))
        target, kp, kd = self._driven
        self._asked = motor_torque(target, self.q, self.qd, Gains(kp, kd, self.bundle.curve.peak), self.bundle.curve)
        return self.safety.check(
            record["received"], self.q, self.qd, self.torque, limit, self.temperature, self.error, tilt=tilt,
            stale=self.stale, diverged=bool(self.estimate.diverged), finite=self._finite, late=float(record["late"]),
            stop=request == Request.STOP, sign=getattr(self._procedure, "failed", False),
        )  # fmt: skip

    def _passive(self, request: Request, values: np.ndarray) -> np.ndarray:
        """Return frames that keep the motors off until the operator enables them; then those of MIT mode."""
        if request == Request.ZERO:
            frames = self.off.copy()
            frames[self.bundle.joints.motor[int(values[0])]] = np.frombuffer(ZERO, np.uint8)
            self._rest_ticks = 0
            return frames
        if request == Request.STAND:
            waits = Fault.MOVING if self._rest_ticks < REST_TICKS else Fault.NONE
            self.reason = (self.safety.fault or waits) if self.ready else Fault.SILENT
            if not self.reason:
                self._enter(State.STAND_UP)
                self._enter_ticks = ENTER_TICKS
                return self._commands()
        return self.off

    def _requests(self, request: Request, values: np.ndarray) -> None:
        """Change the state as the operator requests, or as a skill has ended."""
        state = self.state
        if request == Request.PASSIVE and state in (State.DAMP, State.STAND_UP):
            self._enter(State.PASSIVE)
        elif state == State.STAND_UP:
            if request == Request.CONFIRM and self._procedure is None:
                self._procedure = Ramp(self.q, *self._stand_up, self.dt)
            elif self._procedure is not None and self._procedure.done:
                self._enter(State.HOLD)
        elif request == Request.HOLD and state == State.WALK:
            self._enter(State.HOLD)
        elif request == Request.CONFIRM and state == State.HOLD:
            self._procedure = sign_test(self.bundle.default, self.dt)
        elif request == Request.JOINT and state == State.HOLD:
            self._procedure = joint_test(self.bundle.default, int(values[0]), self.dt)
        elif request == Request.WALK and state == State.WALK:
            self.skill.wanted = np.clip(values, self.skill.lowest, self.skill.highest)
        elif request == Request.WALK and state == State.HOLD and State.WALK in self.skills:
            self._enter(State.WALK, values)
        elif JUMP_OF_REQUEST.get(request) in self.skills and state in (State.WALK, State.HOLD):
            self.pending = (JUMP_OF_REQUEST[request], values)
        pending, due = self.pending, self._time >= self._due
        if pending and due and (state == State.HOLD or self.skill.ready_to_jump(self.motion)):
            self._enter(*pending)

    @property
    def skill(self) -> Any:
        """The active skill."""
        return self.skills[self.state]

    def _enter(self, state: State, values: Any = (0.0, 0.0, 0.0)) -> None:
        """Change the state; values: of the request that a skill takes."""
        self.pending = None
        self._request = NO_REQUEST
        self._procedure = None
        self._finite, self._rest_ticks = True, 0
        self._driven = (self._target, 0.0 * self.damping, 0.0 * self.damping)  # until `_commands`
        self.state = state
        self._gains = self.bundle.hold
        if state in self.skills:
            self.skill.begin(np.clip(values, self.skill.lowest, self.skill.highest), self.motion, self._target)
            self._gains = self.skill.gains
            self._due = self._time  # the policy acts in this tick
        if state == State.HOLD:
            self._procedure = Ramp(self._target, [self.bundle.default], 0.5, self.dt)
        if state == State.LANDING:
            self._target = self.bundle.default
            self._procedure = BallisticLanding(self.dt)

    def _act(self) -> None:
        """Update the targets: of the skill in its policy steps, else of a procedure."""
        if self.state in self.skills:
            if self._time < self._due:
                return
            self._due += self._policy_step
            try:
                target = self.skill.targets(self.motion)
                self._finite = bool(np.isfinite(target).all())
                self._target = target if self._finite else self._target
            except InputError:
                self._finite = False
            if self.skill.done:
                self._enter(State.WALK if State.WALK in self.skills else State.HOLD)
                self._act()
        elif isinstance(self._procedure, BallisticLanding):
            loaded = np.abs(self.torque[self.bundle.joints.transversal]).mean() > 3.0  # [N m]
            blind = bool(self.estimate.diverged) or (self.stale and not isinstance(self.source, MotionCapture))
            if self._procedure.step(bool(loaded if blind else self._contact.any()), blind):
                self._enter(State.DAMP)
        elif self._procedure is not None:
            self._target = self._procedure.step(self.motion)

    def _commands(self) -> np.ndarray:
        """Return the frames of the present targets, within the torque limits of the joints at the next tick."""
        if self.state == State.PASSIVE:
            return self.off
        if self.state == State.STAND_UP and self._enter_ticks:
            self._enter_ticks -= 1
            return self.enter
        if self.state == State.DAMP or (self.state == State.STAND_UP and self._procedure is None):
            self._driven = (self.q, 0.0 * self.damping, self.damping)
        else:
            expected = self.q + np.float32(self.dt) * self.qd
            target = clip_target(self._target, expected, self.qd, self._gains)
            self._driven = (target, self._gains.kp, self._gains.kd)
        return self.bundle.joints.frames(*self._driven)

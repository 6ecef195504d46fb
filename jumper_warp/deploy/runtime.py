"""Runtime of the robot: a state machine that turns a tick's frames into the frames of the next commands.

`Runtime.tick` sends the frames that the last tick computed, collects the replies, and computes the next frames. It
depends on nothing but its arguments and the received frames, so that a log replays bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any

import numpy as np

from jumper_warp.deploy.bundle import Bundle
from jumper_warp.deploy.bus import RECEIVED, Link
from jumper_warp.deploy.codec import ENTER, EXIT
from jumper_warp.deploy.control import Gains, clip_target
from jumper_warp.deploy.motions import BallisticLanding, Ramp, SignTest
from jumper_warp.deploy.safety import Fault, Safety
from jumper_warp.deploy.sensors import ACCEL_SCALE, GYRO_SCALE, MotionCapture, StateSource, unpack_imu
from jumper_warp.deploy.skills import Jump, Motion, Skill, Walk
from jumper_warp.utils.errors import InputError


class State(IntEnum):
    """States of the robot."""

    PASSIVE = 0  # motors off
    STAND_UP = 1  # from any lying pose, after a confirmation
    HOLD = 2  # stand in the default pose
    WALK = 3
    JUMP_UP = 4
    JUMP_TO = 5
    DAMP = 6  # motors brake
    LANDING = 7  # a fault in flight: the landing pose until touchdown


class Request(IntEnum):
    """Requests of the operator."""

    NONE = 0
    PASSIVE = 1
    STAND = 2  # enable the motors, which brake
    CONFIRM = 3  # stand up
    HOLD = 4
    WALK = 5
    JUMP_UP = 6
    JUMP_TO = 7
    STOP = 8


SKILLS = {"walk": (State.WALK, Walk), "jump_up": (State.JUMP_UP, Jump), "jump_to": (State.JUMP_TO, Jump)}
JUMPS = (State.JUMP_UP, State.JUMP_TO)
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
        self,
        bundle: Bundle,
        link: Link,
        source: StateSource | None = None,
        *,
        rate: int = 480,
        dry_run: bool = False,
        listener: Callable[[np.ndarray], Any] | None = None,
    ) -> None:
        """Start in PASSIVE.

        source: of the base's state; None: a motion capture on the first bus. rate: ticks a second. dry_run: compute
        commands, and send frames that switch the motors off. listener: called with the record of every tick.
        """
        self.bundle = bundle
        self.link = link
        self.source = MotionCapture() if source is None else source
        self.dt = 1.0 / rate
        self.dry_run = dry_run
        self.listener = listener
        self.safety = Safety(bundle.settings["safety"], bundle.settings["closed_chain"]["transversal_sum"])
        self.motion = Motion(bundle.settings["switch"])
        self.skills: dict[State, Skill] = {}
        for name, policy in bundle.policies.items():
            fields = bundle.settings["policies"][name]
            state, kind = SKILLS[fields["skill"]]
            self.skills[state] = kind(policy, Gains.from_yaml(fields), fields["commands"])
        self.damping = np.array(bundle.settings["safety"]["damping"], dtype=np.float32)
        self.off = np.tile(np.frombuffer(EXIT, np.uint8), (12, 1))
        self.frames = self.off
        self.state = State.PASSIVE
        self.reason = Fault.NONE
        self.record = np.zeros((), TICK)
        self.pending: tuple[State, np.ndarray] | None = None  # jump that waits until walking has come to rest
        self._procedure: Any = None
        self._target = bundle.default.copy()
        self._gains = bundle.hold
        self._contact = np.zeros(4, bool)
        self._time, self._due = 0, 0
        self._step, self._policy_step = CLOCK // rate, CLOCK // 60
        self._imu_count, self._started, self._finite = -1, False, True

    @property
    def ready(self) -> bool:
        """Whether all motors and the IMU have sent frames, and the base's state is known."""
        return self._started

    def tick(self, request: Request = Request.NONE, values: Any = (0.0, 0.0, 0.0), late: float = 0.0) -> np.ndarray:
        """Exchange the frames of a tick, compute the next commands, and return the tick's record (of TICK).

        request, values (3,): of the operator. late: delay of the tick's begin [s].
        """
        record = self.record
        record["sent"] = self.off if self.dry_run else self.frames
        self.link.send(record["sent"])
        record["received"] = self.link.collect()
        record["late"], record["request"], record["values"] = late, request, values
        self.frames = self._next(record)
        if self.listener is not None:
            self.listener(record)
        return record

    def _next(self, record: np.ndarray) -> np.ndarray:
        """Return the next frames from a record's received frames, request and lateness; fill its other fields."""
        policy_due = self._time >= self._due
        self._due += self._policy_step if policy_due else 0
        self._time += self._step
        self._read(record)
        request = Request(int(record["request"]))
        if self.state == State.PASSIVE:
            self._passive(request, record)
            frames = self.frames
        elif self._check(record, request) and self.state not in (State.DAMP, State.LANDING):
            flies = self.state in JUMPS and not self._contact.any()
            self.reason = self.safety.fault
            self._enter(State.LANDING if flies else State.DAMP)
            frames = self._commands()
        elif self.safety.fault and self.state not in (State.DAMP, State.LANDING):
            frames = self.frames  # the last safe target
        else:
            self._requests(request, record["values"].astype(float), policy_due)
            self._act(policy_due)
            frames = self._commands()
        record["state"], record["target"] = self.state, self._target
        record["fault"], record["fault_ticks"] = self.safety.fault or self.reason, self.safety.ticks
        record["kp"] = 0.0 if self.state in (State.DAMP, State.PASSIVE) else self._gains.kp
        return frames

    def _read(self, record: np.ndarray) -> None:
        """Decode the received frames and update the state of the base."""
        received = record["received"]
        self.q, self.qd, self.torque, self.temperature, self.error = self.bundle.joints.read(received["motor"])
        self.gyro, count = unpack_imu(received["sensor"][0].tobytes(), GYRO_SCALE)
        self.accel, _ = unpack_imu(received["sensor"][1].tobytes(), ACCEL_SCALE)
        self.stale = not received["sensor_fresh"][:2].all() or count == self._imu_count
        self._imu_count = count
        if isinstance(self.source, MotionCapture) and received["sensor_fresh"][2:].all():
            self.source.receive(received["sensor"][2:])
        if not self._started and received["motor_fresh"].all() and not self.stale:
            self.source.reset(self.gyro, self.accel, self.q, None)
            self._started = True
        self.estimate = self.source.update(self.gyro, self.accel, self.q, self.qd, self.torque, self.dt)
        if not self.estimate.diverged:
            self._contact = self.estimate.contact
        for name in ("angle", "rate", "torque", "position", "velocity", "quaternion", "contact"):
            values = {"angle": self.q, "rate": self.qd, "torque": self.torque}.get(name)
            record[name] = getattr(self.estimate, name) if values is None else values

    def _check(self, record: np.ndarray, request: Request) -> bool:
        """Check the tick for faults, and return whether the policy must end."""
        self.motion.update(self.estimate, self.gyro, self.q, self.qd)
        flies = not self._contact.any() and self.state in JUMPS
        upright = self.state in (State.STAND_UP, State.PASSIVE) or flies
        tilt = 0.0 if upright else float(np.arccos(np.clip(-self.motion.gravity[2], -1.0, 1.0)))
        sign = self.state == State.HOLD and isinstance(self._procedure, SignTest) and self._procedure.failed
        ends = self.safety.check(
            record["received"], self.q, self.qd, self.torque, self._gains.limit, self.temperature, self.error,
            tilt=tilt, stale=self.stale, diverged=bool(self.estimate.diverged), finite=self._finite,
            late=float(record["late"]), stop=request == Request.STOP,
        )  # fmt: skip
        if sign and not ends:
            self.safety.fault, ends = Fault.SIGN, True
        return ends

    def _passive(self, request: Request, record: np.ndarray) -> None:
        """Keep the motors off until the operator enables them; then switch them to MIT mode."""
        self.frames = self.off
        if request == Request.STAND and self._started:
            self._check(record, request)
            if self.safety.fault:
                self.reason = self.safety.fault
                return
            self.reason = Fault.NONE
            self._enter(State.STAND_UP)
            self.frames = np.tile(np.frombuffer(ENTER, np.uint8), (12, 1))

    def _requests(self, request: Request, values: np.ndarray, policy_due: bool) -> None:
        """Change the state as the operator requests, or as a skill has ended."""
        state = self.state
        if request == Request.PASSIVE and state in (State.DAMP, State.STAND_UP):
            self._enter(State.PASSIVE)
        elif state == State.STAND_UP:
            if request == Request.CONFIRM and self._procedure is None:
                settings = self.bundle.settings["stand_up"]
                poses = [np.array(settings["folded"], np.float32), self.bundle.default]
                self._procedure = Ramp(self.q, poses, settings["seconds"], self.dt)
            elif self._procedure is not None and self._procedure.done:
                self._enter(State.HOLD)
        elif request == Request.HOLD and state == State.WALK:
            self._enter(State.HOLD)
        elif request == Request.CONFIRM and state == State.HOLD:
            self._procedure = SignTest(self.bundle.default, self.dt)
        elif request == Request.WALK and state == State.WALK:
            self.skill.wanted = np.clip(values, self.skill.lowest, self.skill.highest)
        elif request == Request.WALK and state == State.HOLD and State.WALK in self.skills:
            self._enter(State.WALK, values)
        elif request in (Request.JUMP_UP, Request.JUMP_TO) and state in (State.WALK, State.HOLD):
            wanted = State.JUMP_UP if request == Request.JUMP_UP else State.JUMP_TO
            if wanted in self.skills:
                self.pending = (wanted, values)
        if self.pending is not None and policy_due and (state == State.HOLD or self.skill.ready_to_jump(self.motion)):
            wanted, values = self.pending
            self._enter(wanted, values)

    @property
    def skill(self) -> Any:
        """The active skill."""
        return self.skills[self.state]

    def _enter(self, state: State, values: Any = (0.0, 0.0, 0.0)) -> None:
        """Change the state; values: of the request that a skill takes."""
        self.pending = None
        self._procedure = None
        self._finite = True
        self.state = state
        if state in self.skills:
            skill = self.skill
            skill.begin(np.clip(np.array(values, dtype=float), skill.lowest, skill.highest), self.motion)
            self._gains = self.skill.gains
            self._due = self._time - self._step  # the policy acts in this tick
        else:
            self._gains = self.bundle.hold
        if state == State.HOLD:
            self._procedure = Ramp(self._target, [self.bundle.default], 0.5, self.dt)
        if state == State.LANDING:
            self._target = self.bundle.default
            self._procedure = BallisticLanding(self.dt)

    def _act(self, policy_due: bool) -> None:
        """Update the targets: of the skill in its policy steps, else of a procedure."""
        if self.state in self.skills:
            if not policy_due and self._due != self._time - self._step:
                return
            if self._due == self._time - self._step:
                self._due += self._policy_step
            try:
                target = self.skill.targets(self.motion)
                self._finite = bool(np.isfinite(target).all())
                self._target = target if self._finite else self._target
            except InputError:
                self._finite = False
            if self.skill.done:
                back = State.WALK if State.WALK in self.skills and self.state != State.WALK else State.HOLD
                self._enter(back)
                self._act(policy_due)
        elif self._procedure is not None:
            if isinstance(self._procedure, BallisticLanding):
                loaded = np.abs(self.torque[self.bundle.joints.transversal]).mean() > 3.0  # [N m]
                blind = self.estimate.diverged or (self.stale and not isinstance(self.source, MotionCapture))
                if self._procedure.step(bool(loaded if blind else self._contact.any()), blind):
                    self._enter(State.DAMP)
                return
            self._target = self._procedure.step(self.motion)

    def _commands(self) -> np.ndarray:
        """Return the frames of the present targets, within the torque limits of the joints at the next tick."""
        zero = np.zeros(12, np.float32)
        if self.state == State.PASSIVE:
            return self.off
        if self.state == State.DAMP or (self.state == State.STAND_UP and self._procedure is None):
            return self.bundle.joints.frames(self.q, zero, self.damping)
        expected = self.q + np.float32(self.dt) * self.qd
        target = clip_target(self._target, expected, self.qd, self._gains)
        return self.bundle.joints.frames(target, self._gains.kp, self._gains.kd)

"""One recorded motion against its replay: weighed residuals, and their Jacobian by worlds that differ a little."""

from __future__ import annotations

import copy
import math
from typing import NamedTuple

import numpy as np

from jumper_warp.identification.motions import DEGREES, Motion, NoiseLevels
from jumper_warp.identification.parameters import BASE_ONLY, ParameterSet
from jumper_warp.identification.replay import Record, Replay, Starts
from jumper_warp.identification.stance import HANGING_HEIGHT, levelled, levelling, stance
from jumper_warp.robot.description import RobotDescription
from jumper_warp.robot.values import RobotValues
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.rotations import CONJUGATE, from_rotation_vector, multiply, rotate, to_rotation_vector

LONGEST_GAP = 0.1
"""[s] Between two rows of a motion."""
LONGEST_LATENCY = 0.05
"""[s] Targets that long before the first row matter."""
SETTLING = 0.02
"""[s] From the start on, in which rows of a motion on the ground do not count: paws that do not stand on it exactly
strike it, and when each does is a matter of micrometres."""
FIRST_ROWS = 8
"""Rows in which a motion's start is measured."""
QUIET_ROWS = 2
QUIET = 0.2
"""[rad/s] Mean rate over the first rows of a motion below which a robot that stands has all paws on the ground."""
TRUST = 3.0
"""Deviations of the noise by which a start may differ from what is measured there, so that it hardly counts twice."""
DIFFERENCE = 1.0e-5
"""Change of an unknown for its column of the Jacobian, in deviations of its prior."""


class NothingMeasured(InputError):
    """A motion in which no row says anything that a replay could be compared to."""


class Linearised(NamedTuple):
    """Residuals and Jacobian of one motion."""

    residual: np.ndarray
    """(m,)"""
    jacobian: np.ndarray
    """(m, P + I)"""


class MotionResiduals:
    """A motion on the grid of physics steps. Unknowns are normalised: parameters (P,), and a start of I coordinates.

    A start has the sensors' readings and rates of 12 motors, the base's rotation vector, and for a free base its
    position, velocity and spin (world frame), as deviations from what the first rows measure.
    """

    def __init__(
        self,
        motion: Motion,
        parameters: ParameterSet,
        noise: NoiseLevels,
        description: RobotDescription,
        dt: float | None = None,
        span: tuple[int, int] | None = None,
    ):
        """Prepare; dt [s]: largest physics step, by default 1/480; span: first row and one past the last, else all.

        Raises InputError: angles of the wrong sign, gaps, or nothing to compare.
        """
        motion.check_signs()
        whole, (first, end) = motion, span or (0, len(motion.time))
        motion = whole.cut(first, end)
        self.motion, self.parameters, self.description = motion, parameters, description
        gaps = np.diff(motion.time)
        if gaps.max() > LONGEST_GAP:
            row = int(np.argmax(gaps)) + 1
            raise InputError(f"motion {motion.name}: {gaps.max():.3g} s pass before row {row}: split it there")
        period = float(np.median(gaps))
        uniform = bool(
            np.abs(motion.time - motion.time[0] - period * np.arange(len(motion.time))).max() < 0.01 * period
        )
        self.stride, self.dt = grid_steps(period, dt) if uniform else (1, grid_steps(1.0, dt)[1])
        self._place = np.arange(len(motion.time), dtype=float)
        if not uniform:
            self._place = (motion.time - motion.time[0]) / self.dt
        self.rows = int(math.ceil(self._place[-1] - 1.0e-9)) + 1
        lead = self.stride * min(math.ceil(LONGEST_LATENCY / (self.stride * self.dt)), 10**6 if first else 0)
        steps = motion.time[0] + self.dt * np.arange(-lead, self.rows * self.stride)
        held = np.searchsorted(whole.time, steps + 1.0e-6 * period, side="right") - 1
        self.target, self.lead = whole.target[np.maximum(held, 0)], lead
        self.free = motion.base == "free"
        self.start_size = 36 if self.free else 27
        self._measure(noise)
        self._guess_start(noise.of_channels())
        if self.free and not self.resting:
            self.valid[motion.time < motion.time[0] + SETTLING] = False
        if not self.valid.any():
            raise NothingMeasured(f"motion {motion.name}: nothing is measured that a replay could be compared to")
        self.plan = self._plan()

    def _measure(self, noise: NoiseLevels) -> None:
        """Collect what is measured in columns, NaN where it is not."""
        motion, columns = self.motion, []
        self.channels: list[tuple[str, slice]] = []
        sigma, legs, first = [], [], 0
        for name, (deviation, width) in noise.of_channels().items():
            source = motion.quaternion if name == "orientation" else getattr(motion, name)
            if source is None or (not self.free and name == "position"):
                continue
            if name == "orientation":  # its error is compared to 0
                source = np.where(np.isnan(source).any(axis=1)[:, None], math.nan, np.zeros((1, 3)))
            columns.append(source)
            sigma += width * [deviation]
            legs += [i // 3 for i in range(12)] if width == 12 else width * [-1]
            self.channels.append((name, slice(first, first + width)))
            first += width
        self.measured = np.concatenate(columns, axis=1) if columns else np.zeros((len(motion.time), 0))
        self.valid = np.isfinite(self.measured)
        self.sigma, self._leg = np.array(sigma), np.array(legs)

    def _guess_start(self, noise: dict[str, tuple[float, int]]) -> None:
        """Set what the first rows say of the start, and how well."""
        motion, rows = self.motion, min(FIRST_ROWS, len(self.motion.time))
        angle, angle_prior = first_values(motion.angle, motion.target[0], TRUST * noise["angle"][0], 10.0 * DEGREES)
        rate, rate_prior = first_values(motion.rate, None, TRUST * noise["rate"][0], 1.0)
        if motion.rate is None and motion.angle is not None:
            rate, rate_prior = slope(motion.time[:rows], motion.angle[:rows]), np.full(12, 1.0)
        level, place = np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.0, 0.0, HANGING_HEIGHT])
        quaternion, _ = first_values(motion.quaternion, level, 0.0, 0.0)
        quaternion = quaternion / np.linalg.norm(quaternion)
        tilt = np.full(3, math.radians(2.0 if motion.quaternion is not None else 5.0))
        velocity, base = np.zeros(3), []
        self.standing = self.resting = False
        if self.free:
            ground = stance(self.description, angle[None], rate[None])
            place[2] = ground.height[0]
            place, place_prior = first_values(motion.position, place, 0.02, 0.05)
            up = rotate(quaternion * CONJUGATE, np.array([0.0, 0.0, 1.0]))
            near = abs(place[2] - ground.height[0]) < 0.03 and float(up @ ground.up[0]) > math.cos(math.radians(6.0))
            self.standing = near and ground.gap[0] < 0.02
            if motion.position is not None:
                velocity = slope(motion.time[:rows], motion.position[:rows])
            base = [place_prior, np.full(3, 0.3), np.full(3, 1.0)]
            if self.standing:  # the ground says more than sensors
                tilt = np.array([0.2 * DEGREES, 0.2 * DEGREES, tilt[2]])
                base = [np.array([0.02, 0.02, 0.001]), np.full(3, 0.05), np.full(3, 0.3)]
                self.resting = quiet(motion.rate)
                self._levelling = levelling(self.description, angle)
        self._guess = Starts(*(x[None] for x in (place, quaternion, velocity, np.zeros(3), angle, rate)))
        self._start_prior = np.concatenate([angle_prior, rate_prior, tilt, *base])

    def until(self, part: float) -> MotionResiduals:
        """Return the first part of it, a share of its rows; the start is the same."""
        if part >= 1.0:
            return self
        found = copy.copy(self)
        end = max(3, round(part * len(self.motion.time)))
        found.motion, found._place = self.motion.cut(0, end), self._place[:end]
        found.rows = int(math.ceil(found._place[-1] - 1.0e-9)) + 1
        found.measured, found.valid = self.measured[:end], self.valid[:end]
        return found

    def starts(self, z: np.ndarray, robots: RobotValues) -> Starts:
        """Return the starts of normalised coordinates (N, I); true angles are readings less the robots' offsets.

        All paws of a robot that stands begin on the ground, but for what the coordinates add to that.
        """
        guess, d = self._guess, z * self._start_prior
        start = Starts(*(np.repeat(getattr(guess, name), len(z), axis=0) for name in vars(guess)))
        start.angle = start.angle + d[:, :12] - robots.offset
        start.rate = start.rate + d[:, 12:24]
        if self.resting:
            start.angle, start.rate = levelled(self.description, start.angle, start.rate, self._levelling)
        if self.standing:
            ground = stance(self.description, start.angle, start.rate)
            turned = rotate(start.quaternion, ground.up)  # to be brought to the vertical, about a level axis
            half = np.stack([turned[:, 1], -turned[:, 0], np.zeros(len(z)), 1.0 + turned[:, 2]], axis=1)
            start.quaternion = multiply(half / np.linalg.norm(half, axis=1, keepdims=True), start.quaternion)
            start.position[:, 2] = ground.height
            start.velocity, start.spin = (rotate(start.quaternion, v) for v in (ground.velocity, ground.spin))
        start.quaternion = multiply(from_rotation_vector(d[:, 24:27]), start.quaternion)
        if self.free:
            start.position = start.position + d[:, 27:30]
            start.velocity = start.velocity + d[:, 30:33]
            start.spin = start.spin + d[:, 33:36]
        return start

    def run(self, replay: Replay, z: np.ndarray, start: np.ndarray) -> tuple[Record, RobotValues]:
        """Replay with N unknowns (N, P), (N, I)."""
        robots = self.parameters.robots(z, self.description)
        motion = self.motion
        record = replay.run(
            robots, self.starts(start, robots), self.target, rows=self.rows, stride=self.stride, dt=self.dt,
            lead=self.lead, base=motion.base, gains=motion.gains, torque_limit=motion.torque_limit,
        )  # fmt: skip
        return record, robots

    def predicted(self, record: Record, robots: RobotValues) -> np.ndarray:
        """Return what the sensors would read, (n, columns, N); orientation as the error to what was measured."""
        low = np.minimum(self._place.astype(int), len(record.angle) - 1)
        high = np.minimum(low + 1, len(record.angle) - 1)
        part = (self._place - low)[:, None, None]

        def at_rows(values: np.ndarray) -> np.ndarray:
            return values[low] if not part.any() else (1.0 - part) * values[low] + part * values[high]

        columns = []
        for name, _ in self.channels:
            if name == "orientation":
                found = np.moveaxis(at_rows(record.quaternion), 1, 2)
                found = found / np.linalg.norm(found, axis=-1, keepdims=True)
                known = np.nan_to_num(np.asarray(self.motion.quaternion)) + np.array([0.0, 0.0, 0.0, 1.0e-12])
                known = known / np.linalg.norm(known, axis=-1, keepdims=True) * CONJUGATE
                columns.append(np.moveaxis(to_rotation_vector(multiply(found, known[:, None])), 1, 2))
            else:
                values = at_rows(getattr(record, name))
                columns.append(values + robots.offset.T if name == "angle" else values)
        return np.concatenate(columns, axis=1)

    def residuals(self, replay: Replay, z: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Return weighed residuals (m, N); infinite where a world broke."""
        record, robots = self.run(replay, z, start)
        error = self.predicted(record, robots) - self.measured[:, :, None]
        found = (error / self.sigma[:, None])[self.valid]
        found[:, ~record.valid] = math.inf
        return found

    def linearise(
        self, replay: Replay, z: np.ndarray, start: np.ndarray, change: np.ndarray | float = DIFFERENCE
    ) -> Linearised:
        """Return residuals and Jacobian at one point, (P,) and (I,), by one-sided differences in parallel worlds.

        change: of each unknown, (P + I,). Where a world broke, the Jacobian is not a number. An exact
        Jacobian (one-step adjoints over the recorded steps) would replace this method alone.
        """
        change = np.broadcast_to(change, len(z) + len(start))
        many_z, many_start = (np.repeat(x[None], len(self.plan) + 1, axis=0) for x in (z, start))
        size = len(z)
        for world, columns in enumerate(self.plan, 1):
            for column, _ in columns:
                if column < size:
                    many_z[world, column] += change[column]
                else:
                    many_start[world, column - size] += change[column]
        found = self.residuals(replay, many_z, many_start)
        if not np.isfinite(found).all():
            return Linearised(found[:, 0], np.full((len(found), size + self.start_size), math.nan))
        differences = found[:, 1:] - found[:, :1]
        leg = np.broadcast_to(self._leg, self.measured.shape)[self.valid]
        jacobian = np.zeros((len(found), size + self.start_size))
        for world, columns in enumerate(self.plan):
            for column, of_leg in columns:
                slope = differences[:, world] / change[column]
                jacobian[:, column] = slope if of_leg is None else np.where(leg == of_leg, slope, 0.0)
        return Linearised(found[:, 0], jacobian)

    def _plan(self) -> list[list[tuple[int, int | None]]]:
        """Return the columns (index, leg or None) that each world of the Jacobian changes.

        While the base is held the legs do not feel each other: unknowns of four legs share a world.
        """
        size, single, shared = len(self.parameters), [], {}
        known = (24, 25, 29, 32, 33, 34) if self.resting else ()
        for i, parameter in enumerate(self.parameters):
            if self.free:
                single.append([(i, None)])
            elif parameter.quantity not in BASE_ONLY:
                if parameter.leg is None:
                    single.append([(i, None)])
                else:
                    shared.setdefault((parameter.quantity, parameter.places[0] % 3), []).append((i, parameter.leg))
        for i in range(self.start_size):
            if i in known:
                continue
            if self.free or i >= 24:
                single.append([(size + i, None)])
            else:
                shared.setdefault(("start", i // 12, i % 3), []).append((size + i, i % 12 // 3))
        return [*single, *shared.values()]


def quiet(rate: np.ndarray | None) -> bool:
    """Return whether the joints hardly move in the first rows [rad/s]."""
    if rate is None or np.isnan(rate[:QUIET_ROWS]).all(axis=0).any():
        return False
    return bool((np.abs(np.nanmean(rate[:QUIET_ROWS], axis=0)) < QUIET).all())


def first_values(
    values: np.ndarray | None, default: np.ndarray | None, prior: float, wide: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first value of each column that is measured, else the default, and how well it is known."""
    if values is None:
        default = np.zeros(12) if default is None else default
        return default.copy(), np.full(len(default), wide)
    found = np.zeros(values.shape[1]) if default is None else default.copy()
    known = np.isfinite(values[:FIRST_ROWS]).any(axis=0)
    for i in np.flatnonzero(known):
        column = values[:FIRST_ROWS, i]
        found[i] = column[np.isfinite(column)][0]
    return found, np.where(known, prior, wide)


def slope(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the slope of each column by least squares, 0 where fewer than three values are known."""
    found = np.zeros(values.shape[1])
    for i in range(values.shape[1]):
        known = np.isfinite(values[:, i])
        if known.sum() >= 3:
            found[i] = np.polyfit(time[known] - time[0], values[known, i], 1)[0]
    return found


def grid_steps(period: float, dt: float | None) -> tuple[int, float]:
    """Return the physics steps in a sample period [s], and the step [s]: at most dt, by default 1/480 s."""
    longest = 1.0 / 480.0 if dt is None else dt
    if not 1.0e-6 <= longest <= 0.01:
        raise InputError(f"dt must lie in 1e-6 to 0.01 s, got {dt}")
    steps = max(1, math.ceil(period / longest - 1.0e-6))
    return steps, period / steps

"""Residuals between a recorded motion and its simulation, divided by the noise, and their Jacobian."""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jumper_warp.identification.initial_states import InitialStatePrior
from jumper_warp.identification.motions import NoiseLevels, RecordedMotion
from jumper_warp.identification.parameters import BASE_ONLY, ParameterSet
from jumper_warp.identification.replay import MotionReplay, Record
from jumper_warp.robot.description import MOTOR_JOINTS, RobotDescription
from jumper_warp.robot.values import RobotValues
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.rotations import CONJUGATE, multiply, to_rotation_vector

LONGEST_GAP = 0.1  # [s] longest allowed time between two rows of a motion
LONGEST_LATENCY = 0.05  # [s] targets sent up to this long before the first row can act in the motion
SETTLING = 0.02
"""[s] Initial time without residuals if a robot on the ground is not at rest: its paws strike the ground at times that
depend on micrometres."""
JITTER = 0.01
"""[1] Largest deviation of uniform time stamps from a straight line over their period, and tolerance on the number of
physics steps in a period. Clocks round stamps: those of Unix time to 0.24 µs."""
FAR_APART = math.radians(20.0)
"""[rad] Root mean square of angle minus target above which `check_signs` compares their signs."""
PIECE = 0.25  # [s] length of the pieces that motions on the ground are first cut into
DIFFERENCE = 1.0e-5  # Default step of finite differences by an unknown, in standard deviations of its prior
FIXED_AT_REST = (24, 25, 29, 32, 33, 34)
"""Coordinates of a resting initial state that contact determines: roll, pitch, height, z velocity, roll, pitch rate."""


class NothingMeasured(InputError):
    """Error for a motion without measurements to compare with a replay."""


class Linearised(NamedTuple):
    """Residuals of one motion, divided by the noise, and their Jacobian w.r.t. the normalised unknowns."""

    residual: np.ndarray  # (m,)
    jacobian: np.ndarray  # (m, P + I) by the P parameters and the I coordinates of the initial state


class MotionResiduals:
    """The m residuals of a recorded motion: simulated minus measured values, divided by the sensor noise.

    Unknowns are normalised: P parameters and the I coordinates of an initial state, see `InitialStatePrior`.
    """

    def __init__(
        self,
        motion: RecordedMotion,
        parameters: ParameterSet,
        noise: NoiseLevels,
        description: RobotDescription,
        dt: float | None = None,
        span: tuple[int, int] | None = None,
    ):
        """Prepare to compare rows of a recorded motion with its simulation.

        dt [s]: largest physics step, default 1/480; span: first row, end row. Raises InputError: angles of the wrong
        sign, gaps, or dt out of range; NothingMeasured.
        """
        check_signs(motion)
        whole = motion
        (first, end) = span or (0, len(motion.time))
        motion = rows_of(whole, first, end)
        self.motion = motion
        self.parameters = parameters
        self.description = description
        self.free = motion.base == "free"
        begin = self._make_grid(dt)
        self.lead = self.stride * min(math.ceil(LONGEST_LATENCY / (self.stride * self.dt)), 10**6 if first else 0)
        self.target = mean_targets(whole, begin + self.dt * np.arange(-self.lead, self.rows * self.stride + 1))
        self._collect_measurements(noise)
        self.initial = InitialStatePrior(motion, noise, description)
        self.start_size = self.initial.size
        if self.free and not self.initial.resting:
            self.valid[self._grid_row < SETTLING / (self.stride * self.dt) - JITTER] = False
        if not self.valid.any():
            raise NothingMeasured(f"motion {motion.name}: no measurements to compare with a replay")
        self.jacobian_worlds = self._plan_jacobian()

    def _make_grid(self, dt: float | None) -> float:
        """Align the rows of a recording with physics steps of at most dt [s]; return the time [s] of the first step.

        With uniform time stamps a fitted line gives the period, and each row falls on a step: the step divides the
        period. Else rows lie between steps. Sets stride, dt, rows and the row's position on the grid. Stamps that are
        uniform but for `JITTER` count as uniform. Raises InputError: a gap above `LONGEST_GAP`.
        """
        motion = self.motion
        index = np.arange(len(self.motion.time), dtype=float)
        gaps = np.diff(motion.time)
        if gaps.max() > (1.0 + JITTER) * LONGEST_GAP:
            row = int(np.argmax(gaps)) + 1
            raise InputError(f"motion {motion.name}: gap of {gaps.max():.3g} s before row {row}: split it there")
        time = motion.time - motion.time[0]
        begin = 0.0
        period, middle = np.polyfit(index - index.mean(), time, 1)
        if np.abs(time - middle - period * (index - index.mean())).max() < JITTER * period:
            (self.stride, self.dt) = grid_steps(period, dt)
            self._grid_row = index
            begin = middle - period * index.mean()
        else:
            self.stride = 1
            self.dt = grid_steps(1.0, dt)[1]
            self._grid_row = time / self.dt
        self.rows = int(math.ceil(self._grid_row[-1] - 1.0e-9)) + 1
        return float(motion.time[0] + begin)

    def _collect_measurements(self, noise: NoiseLevels) -> None:
        """Collect the measured values of the motion with their noise, and mark missing ones.

        Sets `measured` and `valid` (n, columns), `sigma` (columns,) [SI] and `channels`, (name, columns) each.
        """
        motion = self.motion
        columns = []
        self.channels: list[tuple[str, slice]] = []
        sigma = []
        legs = []
        first = 0
        for name, (std, width) in channel_noise(noise).items():
            source = motion.quaternion if name == "orientation" else getattr(motion, name)
            if source is None or (not self.free and name == "position"):
                continue
            if name == "orientation":  # its error is compared to 0
                source = np.where(np.isnan(source).any(axis=1)[:, None], math.nan, np.zeros((1, 3)))
            columns.append(source)
            sigma += width * [std]
            legs += [i // 3 for i in range(12)] if width == 12 else width * [-1]
            self.channels.append((name, slice(first, first + width)))
            first += width
        self.measured = np.concatenate(columns, axis=1) if columns else np.zeros((len(motion.time), 0))
        self.valid = np.isfinite(self.measured)
        self.sigma = np.array(sigma)
        self._leg = np.array(legs)

    def first_part(self, fraction: float) -> MotionResiduals:
        """Return the residuals of the first `fraction` (0 to 1) of the rows; the initial state's prior is unchanged."""
        if fraction >= 1.0:
            return self
        part = copy.copy(self)
        end = max(3, round(fraction * len(self.motion.time)))
        part.motion = rows_of(self.motion, 0, end)
        part._grid_row = self._grid_row[:end]
        part.rows = int(math.ceil(part._grid_row[-1] - 1.0e-9)) + 1
        part.measured, part.valid = self.measured[:end], self.valid[:end]
        return part

    def linearise(
        self, replay: MotionReplay, z: np.ndarray, start: np.ndarray, change: np.ndarray | float = DIFFERENCE
    ) -> Linearised:
        """Compute the residuals of the motion and their Jacobian w.r.t. the unknowns by one-sided differences.

        World 0 is at parameters z (P,) and initial state start (I,), each further one changes some unknowns, as
        `_plan_jacobian` has assigned them: where unknowns of the four legs share a world, each counts for the residuals
        of its leg alone. change: step by unknown, (P + I,) or one for all. The whole Jacobian is NaN if any world
        diverges.
        """
        change = np.broadcast_to(change, len(z) + len(start))
        many_z, many_start = (np.repeat(x[None], len(self.jacobian_worlds) + 1, axis=0) for x in (z, start))
        size = len(z)
        for world, columns in enumerate(self.jacobian_worlds, 1):
            for column, _ in columns:
                if column < size:
                    many_z[world, column] += change[column]
                else:
                    many_start[world, column - size] += change[column]
        residuals = self.residuals(replay, many_z, many_start)
        if not np.isfinite(residuals).all():
            return Linearised(residuals[:, 0], np.full((len(residuals), size + self.start_size), math.nan))
        differences = residuals[:, 1:] - residuals[:, :1]
        row_leg = np.broadcast_to(self._leg, self.measured.shape)[self.valid]
        jacobian = np.zeros((len(residuals), size + self.start_size))
        for world, columns in enumerate(self.jacobian_worlds):
            for column, leg in columns:
                slope = differences[:, world] / change[column]
                jacobian[:, column] = slope if leg is None else np.where(row_leg == leg, slope, 0.0)
        return Linearised(residuals[:, 0], jacobian)

    def residuals(self, replay: MotionReplay, z: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Simulate the motion in N worlds, and return its residuals divided by the noise, (m, N).

        z: (N, P), start: (N, I). Infinite where a world diverges.
        """
        record, robots = self.run(replay, z, start)
        error = self.sensor_readings(record, robots) - self.measured[:, :, None]
        residuals = (error / self.sigma[:, None])[self.valid]
        residuals[:, ~record.valid] = math.inf
        return residuals

    def run(self, replay: MotionReplay, z: np.ndarray, start: np.ndarray) -> tuple[Record, RobotValues]:
        """Simulate the motion in N worlds at parameters z (N, P), states start (N, I); return replay and robots."""
        robots = self.parameters.robots(z, self.description)
        motion = self.motion
        record = replay.run(
            robots, self.initial.states(start, robots), self.target, rows=self.rows, stride=self.stride, dt=self.dt,
            lead=self.lead, base=motion.base, gains=motion.gains, torque_limit=motion.torque_limit,
        )  # fmt: skip
        return record, robots

    def sensor_readings(self, record: Record, robots: RobotValues) -> np.ndarray:
        """Return the sensors' readings [SI] in a replay at the measured rows, (n, columns, N), columns as `channels`.

        Orientation is the rotation vector from the measured to the simulated orientation, world frame.
        """
        low = np.minimum(self._grid_row.astype(int), len(record.angle) - 1)
        high = np.minimum(low + 1, len(record.angle) - 1)
        fraction = (self._grid_row - low)[:, None, None]

        def at_rows(values: np.ndarray) -> np.ndarray:
            """Interpolate replayed values (R, ...) linearly to the times of the measured rows, (n, ...)."""
            return values[low] if not fraction.any() else (1.0 - fraction) * values[low] + fraction * values[high]

        columns = []
        for name, _ in self.channels:
            if name == "orientation":
                simulated = np.moveaxis(at_rows(record.quaternion), 1, 2)
                simulated = simulated / np.linalg.norm(simulated, axis=-1, keepdims=True)
                measured = np.nan_to_num(np.asarray(self.motion.quaternion)) + np.array([0.0, 0.0, 0.0, 1.0e-12])
                measured = measured / np.linalg.norm(measured, axis=-1, keepdims=True) * CONJUGATE
                columns.append(np.moveaxis(to_rotation_vector(multiply(simulated, measured[:, None])), 1, 2))
            else:
                values = at_rows(getattr(record, name))
                columns.append(values + robots.offset.T if name == "angle" else values)
        return np.concatenate(columns, axis=1)

    def _plan_jacobian(self) -> list[list[tuple[int, int | None]]]:
        """Assign each unknown that a finite difference perturbs to one of the parallel worlds.

        Returned: by world, (index, leg or None for all legs). While the base is held the legs do not interact: the same
        unknown of the four legs shares a world, which saves three of four simulations. Unknowns without effect, and
        those that contact or a locked axis determines, get no world; their columns of the Jacobian are 0.
        """
        size = len(self.parameters)
        single = []
        shared = {}
        locked = self.initial.locked
        fixed = {*(FIXED_AT_REST if self.initial.resting else ()), *locked, *(12 + i for i in locked)}
        for i, parameter in enumerate(self.parameters):
            if self.free:
                single.append([(i, None)])
            elif parameter.quantity not in BASE_ONLY:
                if parameter.leg is None:
                    single.append([(i, None)])
                else:
                    shared.setdefault((parameter.quantity, parameter.places[0] % 3), []).append((i, parameter.leg))
        for i in range(self.start_size):
            if i in fixed:
                continue
            if self.free or i >= 24:
                single.append([(size + i, None)])
            else:
                shared.setdefault(("start", i // 12, i % 3), []).append((size + i, i % 12 // 3))
        return [*single, *shared.values()]


def channel_noise(noise: NoiseLevels) -> dict[str, tuple[float, int]]:
    """Return noise (standard deviation [SI]) and number of columns of each measured channel.

    Raises InputError: a level is not positive and finite.
    """
    noise.check()
    return {
        "angle": (math.radians(noise.angle), 12),
        "rate": (math.radians(noise.rate), 12),
        "torque": (noise.torque, 12),
        "position": (1.0e-3 * noise.position, 3),
        "orientation": (math.radians(noise.orientation), 3),
    }


def check_signs(motion: RecordedMotion) -> None:
    """Raise InputError if a motor's recorded angles appear to have the wrong sign.

    That is if they are far from its targets, and less than half as far from negated targets. In motions of `recording`
    the distance to the negated targets is over four times that to the targets, so a factor of two separates both signs.
    Motors that stay near 0 pass.
    """
    if motion.angle is None:
        return
    measured = np.isfinite(motion.angle)
    errors = [np.where(measured, motion.angle - sign * motion.target, 0.0) for sign in (1.0, -1.0)]
    rms, negated_rms = (np.sqrt(np.sum(e**2, axis=0) / np.maximum(measured.sum(axis=0), 1)) for e in errors)
    wrong = np.flatnonzero((rms > FAR_APART) & (negated_rms < 0.5 * rms))
    if len(wrong):
        raise InputError(
            f"motion {motion.name}: angles of {', '.join(MOTOR_JOINTS[i] for i in wrong)} have the sign opposite to "
            "their targets: negate angle, rate and torque, or target, of these motors"
        )


def rows_of(motion: RecordedMotion, first: int, end: int) -> RecordedMotion:
    """Return the part of a recorded motion from row `first` to row `end` - 1."""
    if (first, end) == (0, len(motion.time)):
        return motion
    return replace(motion, **{name: values[first:end] for name, values in motion.columns().items()})


def mean_targets(motion: RecordedMotion, edges: np.ndarray) -> np.ndarray:
    """Return the mean target [rad] in each of S time intervals, (S, 12); targets are held until the next row.

    edges: (S + 1,) [s], rising. The first target also holds before the first row. Means are continuous in the time
    stamps, so errors of stamps below a physics step change them by less than a target that is moved to another step.
    """
    first = max(int(np.searchsorted(motion.time, edges[0], side="right")) - 1, 0)
    end = max(int(np.searchsorted(motion.time, edges[-1])), first + 1)
    target = motion.target[first:end]
    changes = motion.time[first + 1 : end] - edges[0]
    knots = np.concatenate([[0.0], changes, [edges[-1] - edges[0]]])
    area = np.concatenate([np.zeros((1, 12)), np.cumsum(np.diff(knots)[:, None] * target, axis=0)])
    at_edges = np.stack([np.interp(edges - edges[0], knots, column) for column in area.T], axis=1)
    return np.diff(at_edges, axis=0) / np.diff(edges)[:, None]


def pieces_of(
    motion: RecordedMotion,
    parameters: ParameterSet,
    noise: NoiseLevels,
    description: RobotDescription,
    dt: float | None,
) -> list[MotionResiduals]:
    """Cut a motion into consecutive pieces about `PIECE` [s] long, and return the residuals of each.

    Unmeasured pieces are left out. dt [s]: as in `MotionResiduals`.
    """
    rows = len(motion.time)
    number = max(1, min(round(motion.duration / PIECE), rows // 4))
    edges = [round(rows * i / number) for i in range(number + 1)]
    pieces = []
    for span in itertools.pairwise(edges):
        try:
            pieces.append(MotionResiduals(motion, parameters, noise, description, dt, span))
        except NothingMeasured:
            continue
    return pieces


def grid_steps(period: float, dt: float | None) -> tuple[int, float]:
    """Divide the time between two recorded rows into equal physics steps of at most dt, within 1 % (`JITTER`).

    Returns (number of steps in a period [s], step [s]); dt: by default 1/480 s. Raises InputError: dt outside 1e-6 to
    0.01 s.
    """
    longest = 1.0 / 480.0 if dt is None else dt
    if not 1.0e-6 <= longest <= 0.01:
        raise InputError(f"dt must lie in 1e-6 to 0.01 s, got {dt}")
    steps = max(1, math.ceil(period / longest - JITTER))
    return steps, period / steps

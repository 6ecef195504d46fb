"""Metrics of recorded episodes, recomputed by NumPy from raw poses, velocities and contacts of every policy step."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.evaluation.jump_metrics import HeightFlags, LandingFlags
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.evaluation.velocities import VelocityFlags, VelocityLog

DT, COMMAND, SECOND = 1.0 / 60.0, 30, 60  # [s] policy step; [policy steps] command to jump, one second
pytestmark = pytest.mark.usefixtures("one_thread")


class Recording:
    """Arrays of the simulation after the reset (row 0) and after every policy step."""

    def __init__(self):
        self.rows = []

    def __call__(self, env):
        q, qd = env.sim.joint_q(), env.sim.joint_qd()
        force = np.linalg.norm(env.sim.paw_force.numpy(), axis=2).T
        rows = {"pos": q[:, :3], "quat": q[:, 3:7], "com_vel": qd[:, :3], "rate": qd[:, 3:6],
                "vel": env.sim.base_velocity(), "down": force > 0.1, "paw": env.robot.paw_pos.numpy().swapaxes(0, 1),
                "hit": env.robot.collisions.numpy().any(axis=0)}  # fmt: skip
        self.rows.append({name: np.array(values) for name, values in rows.items()})

    def __getattr__(self, name):  # (steps, worlds, ...)
        return np.stack([row[name] for row in self.rows])

    def of(self, world):
        """Return the arrays of a world by name."""
        return {name: np.stack([row[name][world] for row in self.rows]) for name in self.rows[0]}


def record(policy, log_of, tmp_path, **conditions):
    """Run episodes of a policy on randomised robots, and return run, log and recording."""
    run, recording = EvaluationRun(policy), Recording()
    run.prepare("test", Conditions(device="cpu", randomize=True, noise=True, **conditions), tmp_path)
    log = log_of(run.evaluation.prepare_task(run.task))
    env, begin = run.env(log.count), log.begin
    log.begin = lambda env: (begin(env), recording(env))
    run.run_episodes(env, log, on_step=lambda log: recording(env))
    return log, recording


def one_jump(rec, world, takeoff_speed):
    """Return a jump's raw outcome: events and lengths, from the recording of one world."""
    raw = rec.of(world)
    pos, vel, down, hit, paw = (raw[name] for name in ("pos", "vel", "down", "hit", "paw"))
    speed = np.linalg.norm(raw["com_vel"], axis=1)
    up = Rotation.from_quat(raw["quat"]).apply([0.0, 0.0, 1.0])[:, 2]
    airborne = ~down.any(axis=1)
    leaves = np.flatnonzero(airborne[1:] & (vel[1:, 2] > takeoff_speed)) + 1
    takeoff = int(leaves[0]) if len(leaves) else None
    touchdown = None
    for step in range(len(pos) if takeoff is None else takeoff + 1, len(pos)):
        if not airborne[step] and vel[step, 2] <= takeoff_speed:
            touchdown = step
            break
        takeoff = takeoff if airborne[step] else step  # contact of a base that rises is part of the push-off
    bad = np.flatnonzero((pos[1:, 2] < 0.10) | hit[1:]) + 1
    fall = int(bad[0]) if len(bad) else None
    rest = len(pos) - 1 if touchdown is None else touchdown + SECOND
    landed = touchdown is not None and (fall is None or fall > rest) and rest < len(pos)
    end = rest if landed else min(rest, len(pos) - 1, len(pos) if fall is None else fall)
    jump = {"landed": landed, "fell": fall is not None and fall <= end, "start": takeoff, "end": end}
    if takeoff is None or takeoff > end:
        return jump | {"apex": pos[end, 2], "takeoff": None, "touchdown": None}
    jump |= {"early": takeoff <= COMMAND, "apex": pos[takeoff : min(end, touchdown or end) + 1, 2].max()}
    if touchdown is None or touchdown > end:
        return jump | {"takeoff": takeoff, "touchdown": None}
    lifts = 0
    for k in range(4):
        first = touchdown + int(np.argmax(down[touchdown : end + 1, k]))
        length = 0
        for step in range(first, end + 1) if down[first, k] else ():
            length = 0 if down[step, k] else length + 1
            lifts = max(lifts, length)
    shifts = []
    for k in range(4):
        before = np.flatnonzero(down[1 : takeoff + 1, k])[-1] + 1
        after = np.flatnonzero(down[touchdown : end + 1, k])
        shifts.append(paw[touchdown + after[0], k, :2] - paw[before, k, :2] if len(after) else [np.nan, np.nan])
    return jump | {
        "takeoff": takeoff, "touchdown": touchdown, "at_rest": landed and speed[rest] < 0.1,
        "still": landed and lifts < 3, "flown": np.linalg.norm((pos[touchdown] - pos[takeoff])[:2]),
        "paws": np.linalg.norm(np.mean(shifts, axis=0)), "tilt": np.degrees(np.arccos(up[touchdown : end + 1].min())),
    }  # fmt: skip


def compare(metrics, expected):
    """Compare metrics with expected values: rates and numbers of trials exactly, lengths and RMSE to 1e-5.

    Angles agree to 2e-4 degrees: the simulation has the cosine of a tilt in float32, 3e-7 over the sine of 7.8 degrees.
    """
    for key, (value, trials) in expected.items():
        assert metrics[key].trials == trials, key
        tolerance = {"rate": 1e-12, "deg": 2e-4}.get(key.split("_")[-1], 1e-5 * abs(float(value)))
        assert metrics[key].value == pytest.approx(float(value), rel=0.0, abs=tolerance), key


def shared_metrics(jumps, reached):
    """Return the metrics of jumps to heights and to places, as (value, trials) by key."""
    n, landed = len(jumps), np.array([jump["landed"] for jump in jumps])
    on_time = np.array([not jump.get("early", False) for jump in jumps])
    at_rest, still = (np.array([bool(jump.get(name)) for jump in jumps]) for name in ("at_rest", "still"))
    success = reached & landed & at_rest & on_time
    rates = {
        "success": success,
        "goal_reached": reached,
        "landed": landed,
        "at_rest": at_rest,
        "no_paw_lift": still,
        "fall": np.array([jump["fell"] for jump in jumps]),
        "miss": landed & ~reached,
        "early": ~on_time,
    }
    tilt = [jump["tilt"] for jump in jumps if jump["landed"]]
    assert 0 < success.sum() < n and landed.sum() < n, "the test needs successes and failures"
    return {f"{name}_rate": (mask.sum() / n, n) for name, mask in rates.items()} | {
        "landing_tilt_mean_deg": (np.mean(tilt), len(tilt))
    }


def test_jumps_to_heights_agree_with_recomputed_ones(tmp_path):
    flags = HeightFlags(num_jumps=80)
    log, rec = record("vertical_jump", lambda task: flags.log(task, 0), tmp_path, push_in_flight=True)
    jumps = [one_jump(rec, world, 0.75) for world in range(80)]
    error = np.array([jump["apex"] for jump in jumps]) - np.linspace(0.5, 1.2, 80)
    expected = shared_metrics(jumps, np.abs(error) <= 0.1)
    expected |= {"apex_error_abs_mean_m": (np.abs(error).mean(), 80), "apex_error_signed_mean_m": (error.mean(), 80)}
    compare(flags.metrics(log), expected)


def test_jumps_to_places_agree_with_recomputed_ones(tmp_path):
    flags = LandingFlags(num_jumps=80, goal_y=(-0.2, 0.2))
    log, rec = record("horizontal_jump", lambda task: flags.log(task, 0), tmp_path, friction=0.35)
    jumps = [one_jump(rec, world, 0.25) for world in range(80)]
    turn = Rotation.from_rotvec(np.outer(log.headings, [0.0, 0.0, 1.0]))
    goals = turn.apply(np.pad(log.goals[:, 0, :2], ((0, 0), (0, 1))))[:, :2]

    def distances(name, jumps_in):
        """Return goal distances [m] of some jumps at the step `name`."""
        return [np.linalg.norm(rec.pos[jumps[i][name], i, :2] - goals[i]) for i in jumps_in]

    landed = [i for i, jump in enumerate(jumps) if jump["landed"]]
    touched = [i for i, jump in enumerate(jumps) if jump["touchdown"] is not None]
    at_rest = dict(zip(landed, distances("end", landed), strict=True))
    reached = np.array([at_rest.get(i, np.inf) <= 0.1 for i in range(80)])
    expected = shared_metrics(jumps, reached) | {
        "goal_distance_at_rest_mean_m": (np.mean([*at_rest.values()]), len(landed)),
        "goal_distance_at_touchdown_mean_m": (np.mean(distances("touchdown", touched)), len(touched)),
        "goal_distance_at_end_mean_m": (np.mean(distances("end", range(80))), 80),
        "distance_flown_mean_m": (np.mean([jumps[i]["flown"] for i in touched]), len(touched)),
        "paw_to_paw_distance_mean_m": (np.mean([jumps[i]["paws"] for i in landed]), len(landed)),
    }
    compare(flags.metrics(log), expected)


def test_walks_agree_with_recomputed_ones(tmp_path):
    rng = np.random.default_rng(5)
    commands = np.concatenate([rng.uniform(-2.2, 2.2, (32, 2, 3)), np.zeros((8, 2, 3))])
    slew = np.repeat([np.inf, 1.25, np.inf], [16, 16, 8])
    log, rec = record(
        "walking", lambda task: VelocityLog(commands, task, 6.0, times=np.array([0.0, 3.0]), slew=slew), tmp_path
    )
    steps = len(rec.rows) - 1
    turn = [Rotation.from_quat(quat) for quat in rec.quat]
    error, settled = np.full((steps, 40, 3), np.nan), np.zeros(steps, dtype=bool)
    command, stood = np.zeros((40, 3)), np.full(40, True)
    for step in range(1, steps + 1):
        target = commands[:, 0 if step <= 3 * SECOND else 1]
        change = np.clip(target - command, -1.25 * DT, 1.25 * DT)
        command = np.where(np.isfinite(slew)[:, None], command + change, target)
        up = turn[step].apply([0.0, 0.0, 1.0])[:, 2]
        stood &= ~(rec.hit[step] | (up < np.cos(np.radians(60.0))))
        vel, rate = turn[step].inv().apply(rec.vel[step]), turn[step].inv().apply(rec.rate[step])
        values = np.stack([vel[:, 0], vel[:, 1], rate[:, 2]], axis=1) - command
        error[step - 1, stood] = values[stood]
        settled[step - 1] = (step - 1) % (3 * SECOND) >= SECOND
    assert 0 < (~stood).sum() < 32, "the test needs falls"
    expected = {"fall_rate": ((~stood).mean(), 40)}
    for i, name in enumerate(("vx_m_s", "vy_m_s", "yaw_rate_rad_s")):
        for prefix, samples, robots in (
            ("", slice(None), slice(16)), ("settled_", settled, slice(16)), ("slewed_", slice(None), slice(16, 32))
        ):  # fmt: skip
            part = error[samples, robots, i]
            trials = int(np.isfinite(part).any(axis=0).sum())
            expected[f"{prefix}rmse_{name}"] = (np.sqrt(np.nanmean(part**2)), trials)
    standing = np.flatnonzero(stood[32:]) + 32
    drift = np.linalg.norm((rec.pos[-1] - rec.pos[0])[standing, :2], axis=1)
    yaw = np.degrees(np.abs(turn[-1].as_euler("ZYX")[standing, 0]))
    expected |= {"standing_drift_mean_m": (drift.mean(), len(standing)),
                 "standing_turn_abs_mean_deg": (yaw.mean(), len(standing))}  # fmt: skip
    compare(VelocityFlags().metrics(log), expected)

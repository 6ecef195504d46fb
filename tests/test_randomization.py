import dataclasses
import math

import numpy as np
import pytest
import torch
import warp as wp
from jump_helpers import DEG, edit_coordinates, edit_episodes, make_env, only
from newton.solvers import SolverMuJoCo

from jumper_warp.randomization import RandomizationCfg
from jumper_warp.simulation import Simulation
from jumper_warp.tasks import make_task
from kernels import parameters
from kernels.task import FLIGHT, LANDED, STANCE

N = 64
TASK = make_task("vertical-jump")
OFF = RandomizationCfg.off()
MOTOR_DOFS = np.array([6 + 5 * leg + joint for leg in range(4) for joint in (0, 1, 3)])
PAPER = {
    "static_friction": (0.9, 1.2), "dynamic_friction": (0.8, 0.9), "base_mass": (-1.0, 2.0), "link_mass": (0.8, 1.2),
    "com_shift": (-0.03, 0.03), "gains": (0.6, 1.4), "no_load_speed": (0.8, 1.2), "cutoff_speed": (0.8, 1.4),
    "motor_friction": (0.005, 0.04), "armature": (0.6, 1.4), "joint_offset": (-2.0, 2.0), "latency": (0.0, 16.0),
    "force": (-5.0, 5.0), "torque": (-3.0, 3.0),
}  # fmt: skip


def randomized(cfg, num_envs=N, **arguments):
    task = dataclasses.replace(TASK, randomization=cfg, reset=only("default"))
    return make_env(num_envs, task=task, **({"randomize": True} | arguments))


def read(env):
    """Return every randomised parameter as the solver, the motors and the environment have it; worlds come last."""
    n, table = env.num_envs, env._dynamics.robot.table.numpy().astype(float)
    legs = np.array([leg * parameters.LEG_ROWS for leg in range(4)])
    links = np.array([[leg + link * parameters.MOMENT_ROWS for link in range(5)] for leg in legs]).ravel()
    base, motors = int(parameters.BASE), env.sim.motors
    moments = table[links[:, None] + np.arange(10)].reshape(20, 10, n)
    three = (legs[:, None] + np.arange(3)).ravel()
    return {
        "static_friction": table[legs + int(parameters.MU_STATIC)],
        "dynamic_friction": table[legs + int(parameters.MU_DYNAMIC)],
        "base_mass": table[base],
        "link_mass": moments[:, 0],
        "link_moments": moments,
        "com_shift": table[base + 1 : base + 4] / table[base],
        "armature": table[three + int(parameters.ARMATURE)],
        "motor_friction": table[three + int(parameters.FRICTION)],
        **{name: getattr(motors, name).numpy().astype(float) for name in ("kp", "kd", "no_load_speed", "cutoff_speed")},
        "motor_offset": motors.offset.numpy().astype(float),
        "joint_offset": env.joint_offset.numpy().astype(float),
        "latency": env.delay.numpy().astype(float),
        "force": env.push.numpy()[:, :3].T.astype(float),
        "torque": env.push.numpy()[:, 3:].T.astype(float),
    }


@pytest.fixture(scope="module")
def nominal():
    """Parameters with every row off."""
    return read(randomized(OFF))


@pytest.fixture(scope="module")
def drawn():
    """Parameters with every row on, in 512 worlds."""
    return read(randomized(RandomizationCfg(), 512))


def fills(values, lower, upper):
    """Whether values stay in a range, reach its ends and lie about its middle."""
    width = upper - lower
    inside = values.min() >= lower - 1e-5 * width and values.max() <= upper + 1e-5 * width
    wide = values.min() < lower + 0.03 * width and values.max() > upper - 0.03 * width
    return inside and wide and abs(values.mean() - 0.5 * (lower + upper)) < 0.1 * width


def test_the_ranges_are_the_papers():
    assert vars(RandomizationCfg()) == PAPER


def test_off_is_the_robot_as_described(nominal):
    first = {name: values[..., :1] for name, values in nominal.items()}
    for name, values in nominal.items():
        np.testing.assert_array_equal(values, np.broadcast_to(first[name], values.shape), err_msg=name)
    for name in ("motor_offset", "joint_offset", "latency", "force", "torque"):
        assert not nominal[name].any(), name
    np.testing.assert_allclose(nominal["static_friction"], nominal["dynamic_friction"])
    assert nominal["base_mass"][0] == pytest.approx(6.431, abs=2e-3)
    assert nominal["base_mass"][0] + nominal["link_mass"][:, 0].sum() == pytest.approx(14.5, abs=0.01)
    np.testing.assert_allclose(nominal["com_shift"][:, 0], [-0.0094, 0.0, 0.0111], atol=1e-5)
    np.testing.assert_allclose(nominal["armature"][:3, 0], [4.69e-3, 4.14e-3, 4.14e-3], rtol=2e-3)
    np.testing.assert_allclose(nominal["kp"], 17.0)
    np.testing.assert_allclose(nominal["kd"][:3, 0], [1.8, 0.8, 0.8], rtol=1e-6)


ROWS = {
    "base_mass": lambda now, then: now["base_mass"] - then["base_mass"],
    "link_mass": lambda now, then: now["link_mass"] / then["link_mass"],
    "com_shift": lambda now, then: now["com_shift"] - then["com_shift"],
    "gains": lambda now, then: np.stack([now["kp"] / then["kp"], now["kd"] / then["kd"]]),
    "no_load_speed": lambda now, then: now["no_load_speed"] / then["no_load_speed"],
    "motor_friction": lambda now, then: now["motor_friction"],
    "armature": lambda now, then: now["armature"] / then["armature"],
    "joint_offset": lambda now, then: now["joint_offset"] / DEG,
    "force": lambda now, then: now["force"],
    "torque": lambda now, then: now["torque"],
    "dynamic_friction": lambda now, then: now["dynamic_friction"],
    "static_friction": lambda now, then: now["static_friction"],
}


@pytest.mark.parametrize("row", ROWS)
def test_a_row_reaches_the_solver_and_fills_its_range(drawn, nominal, row):
    then = {name: values[..., :1] for name, values in nominal.items()}
    assert fills(ROWS[row](drawn, then), *PAPER[row])


def test_draws_are_independent(drawn, nominal):
    """Of links, motors, axes and rows; only the paws of a world share their friction."""
    rows = [
        drawn["base_mass"][None], drawn["link_mass"], drawn["com_shift"], drawn["kp"], drawn["kd"],
        drawn["no_load_speed"], drawn["armature"], drawn["motor_friction"], drawn["joint_offset"], drawn["force"],
        drawn["torque"], drawn["dynamic_friction"][:1], drawn["latency"][None],
    ]  # fmt: skip
    matrix = np.corrcoef(np.concatenate(rows))
    assert np.abs(matrix - np.eye(len(matrix))).max() < 5.0 / math.sqrt(512)
    np.testing.assert_array_equal(drawn["dynamic_friction"], drawn["dynamic_friction"][:1].repeat(4, 0))


def test_cutoff_stays_below_no_load_speed(drawn, nominal):
    share = drawn["cutoff_speed"] / nominal["cutoff_speed"][:, :1]
    assert share.min() >= 0.8 - 1e-5 and share.max() <= 1.4 + 1e-5
    assert (drawn["cutoff_speed"] <= 0.95 * drawn["no_load_speed"] + 1e-4).all()
    free = drawn["cutoff_speed"] < 0.94 * drawn["no_load_speed"]
    assert free.mean() > 0.7 and share[free].min() < 0.82


def test_static_friction_is_not_below_dynamic(drawn):
    assert (drawn["static_friction"] >= drawn["dynamic_friction"] * (1.0 - 1e-6)).all()
    overlapping = dataclasses.replace(OFF, static_friction=(0.6, 1.2), dynamic_friction=(0.8, 1.0))
    found = read(randomized(overlapping))
    assert (found["static_friction"] >= found["dynamic_friction"] * (1.0 - 1e-6)).all()
    assert fills(found["dynamic_friction"], 0.8, 1.0)


def test_latency_is_in_whole_physics_steps_within_the_range(drawn):
    # 16 ms are 7.68 steps of 1/480 s
    assert set(np.unique(drawn["latency"])) == set(range(8))


@pytest.mark.parametrize("steps", [1, 8, 13])  # the last is 12.999999999999998 in floating point
def test_a_latency_of_whole_physics_steps_is_kept(steps):
    env = randomized(dataclasses.replace(OFF, latency=(1000.0 * steps / 480.0,) * 2), 2)
    assert env.delay.numpy().tolist() == [steps] * 2


def test_a_link_gains_mass_and_inertia_alike(drawn, nominal):
    scale = drawn["link_mass"] / nominal["link_mass"][:, :1]
    expected = nominal["link_moments"][..., :1] * scale[:, None, :]
    np.testing.assert_allclose(drawn["link_moments"], expected, rtol=1e-4, atol=1e-8)


AFFECTED = {
    "static_friction": ["static_friction"],
    "dynamic_friction": ["dynamic_friction", "static_friction"],
    "gains": ["kp", "kd"],
    "link_mass": ["link_mass", "link_moments"],
    "joint_offset": ["joint_offset", "motor_offset"],
}


@pytest.mark.parametrize("row", PAPER)
def test_a_row_alone_changes_nothing_else(nominal, row):
    found = read(randomized(dataclasses.replace(OFF, **{row: PAPER[row]}), 4))
    nominal = {name: values[..., :4] for name, values in nominal.items()}
    changed = [name for name in found if not np.allclose(found[name], nominal[name], rtol=1e-6, atol=1e-9)]
    allowed = AFFECTED.get(row, [row])
    assert set(changed) <= set(allowed) and allowed[0] in changed


@pytest.mark.parametrize("row", PAPER)
def test_a_row_off_is_nominal(nominal, row):
    found = read(randomized(dataclasses.replace(RandomizationCfg(), **{row: None}), 4))
    for name in AFFECTED.get(row, [row])[:1]:
        if row == "static_friction":
            np.testing.assert_allclose(found[name], found["dynamic_friction"])
        elif row == "dynamic_friction":
            np.testing.assert_allclose(found[name], np.broadcast_to(found[name][:1, :1], found[name].shape))
        else:
            np.testing.assert_allclose(found[name], nominal[name][..., :4], rtol=1e-6, atol=1e-9)


def test_the_same_seed_draws_the_same_and_another_does_not():
    one, same, other = (read(randomized(RandomizationCfg(), 8, seed=seed)) for seed in (3, 3, 4))
    for name in one:
        np.testing.assert_array_equal(one[name], same[name], err_msg=name)
        assert not np.array_equal(one[name], other[name]), name


def test_drawing_again_begins_with_the_nominal_values(nominal):
    env = randomized(RandomizationCfg())
    before = read(env)
    for _ in range(3):
        env.randomizer.apply(env)
    after = read(env)
    assert not np.array_equal(before["link_mass"], after["link_mass"])
    assert fills(after["link_mass"] / nominal["link_mass"], 0.8, 1.2)


def test_it_reaches_mujoco_too():
    env = randomized(RandomizationCfg(), 2, solver="mujoco")
    assert isinstance(env.sim.solver, SolverMuJoCo)
    model, solver = env.sim.model, env.sim.solver.mjw_model
    mass = model.body_mass.numpy().reshape(2, -1)
    np.testing.assert_allclose(solver.body_mass.numpy()[:, 1:], mass, rtol=1e-6)
    for world in range(2):
        found = np.sort(solver.dof_armature.numpy()[world][solver.dof_armature.numpy()[world] > 1e-3])
        wanted = np.sort(model.joint_armature.numpy().reshape(2, -1)[world][MOTOR_DOFS])
        np.testing.assert_allclose(found, wanted, rtol=1e-5)


# ---------------------------------------------------------------- what they do


def test_pushes_act_on_the_ground_only():
    env = randomized(dataclasses.replace(OFF, force=PAPER["force"], torque=PAPER["torque"]), 9)
    push = env.push.numpy()
    edit_episodes(env, phase=np.repeat([STANCE, FLIGHT, LANDED], 3), command_step=1000)
    env.step(torch.zeros((9, 12)))
    wrench = env.sim.state.body_f.numpy().reshape(9, 21, 6)
    np.testing.assert_array_equal(wrench[[0, 1, 2, 6, 7, 8], 0], push[[0, 1, 2, 6, 7, 8]])
    assert not wrench[3:6].any() and not wrench[:, 1:].any()


def test_a_push_accelerates_the_robot():
    """Lifted off the ground but still counted as standing: momentum grows by force times time."""
    env = randomized(OFF, 2)
    push = np.zeros((2, 6))
    push[1, :3] = [4.0, -3.0, 5.0]
    env.push.assign(push.astype(np.float32))
    q = env.sim.joint_q().copy()
    q[:, 2] += 0.5
    env.sim.state.joint_q.assign(q.ravel())
    env.step(torch.zeros((2, 12)))
    env._dynamics.full_state(env.sim.state.joint_q, env.sim.state.joint_qd, env.sim.state.body_q, env.sim.state.body_qd)
    velocity = env.sim.state.body_qd.numpy().reshape(2, 21, 6)[..., :3].astype(float)
    momentum = (env.sim.model.body_mass.numpy().reshape(2, 21, 1) * velocity).sum(axis=1)
    np.testing.assert_allclose(momentum[1] - momentum[0], np.array([4.0, -3.0, 5.0]) / 60.0, atol=2e-3)


def test_a_sensor_offset_acts_on_the_motor_and_on_the_observation():
    """A motor whose sensor reads too high by d ends where an honest one told to go d lower does."""
    wrong, honest = randomized(OFF, 1), randomized(OFF, 1)
    offset = np.zeros((12, 1), dtype=np.float32)
    offset[4] = 2.0 * DEG
    wrong.joint_offset.assign(offset)
    wrong.sim.motors.offset.assign(offset)
    action = torch.zeros((1, 12))
    lower = action.clone()
    lower[0, 4] = -2.0 / 90.0
    for _ in range(20):
        wrong.step(action)
        honest.step(lower)
    np.testing.assert_allclose(wrong.sim.joint_q(), honest.sim.joint_q(), atol=1e-4)
    seen = (wrong.obs - honest.obs)[0, 12:24].numpy()
    np.testing.assert_allclose(seen, offset[:, 0], atol=1e-4)


def test_the_command_filter_reads_the_position_sensor():
    """With both thighs at 97 degrees the sum is 1 degree before its hard zone; a sensor 2 too high sees it inside."""
    env = randomized(OFF, 2)
    offset = np.zeros((12, 2), dtype=np.float32)
    offset[4, 1] = 2.0 * DEG  # outer motor of leg 1
    env.joint_offset.assign(offset)
    for world in range(2):
        edit_coordinates(env, world, q={13: 97.0 * DEG, 15: 97.0 * DEG})
    env.auto_reset = False
    env.step(torch.ones((2, 12)))  # 135 degrees each, 30 more than the sum may be
    safe = env._views.safe_target.numpy()[4:6] / DEG
    np.testing.assert_allclose(safe, [[135.0, 120.0], [135.0, 120.0]], atol=1e-3)


def test_drawn_sensor_offsets_are_the_same_for_motor_and_observation(drawn):
    np.testing.assert_array_equal(drawn["joint_offset"], drawn["motor_offset"])
    assert drawn["joint_offset"].any()


def test_an_action_arrives_after_its_delay():
    """Against the same robot driven step by step, its motors told the old targets until the new ones arrive."""
    delays = np.array([0, 1, 3, 5, 8])
    env = randomized(OFF, len(delays))
    env.delay.assign(delays.astype(np.int32))
    sim = Simulation(len(delays), motors=TASK.motors, friction=0.9, visuals=False, device="cpu")
    sim.state.joint_q.assign(env.sim.state.joint_q)
    previous = env._views.safe_target.numpy().copy()
    generator = torch.Generator().manual_seed(5)
    spread = []
    for _ in range(6):
        env.step(0.4 * (2.0 * torch.rand((1, 12), generator=generator) - 1.0).repeat(len(delays), 1))
        target = env._views.safe_target.numpy().copy()
        for step in range(8):
            now = wp.array(np.where(step < delays, previous, target), dtype=float, device="cpu")
            sim.physics(1, now)
        previous = target
        np.testing.assert_allclose(env.sim.joint_q()[:, :7], sim.joint_q()[:, :7], atol=2e-4)
        np.testing.assert_allclose(env.sim.joint_qd()[:, MOTOR_DOFS], sim.joint_qd()[:, MOTOR_DOFS], atol=5e-2)
        spread.append(np.abs(np.diff(env.sim.joint_qd()[:, MOTOR_DOFS], axis=0)).max(axis=1))
    assert np.min(np.max(spread, axis=0)) > 0.5  # [rad/s] each delay differs from the next


@pytest.mark.parametrize(
    ("row", "value", "message"),
    [
        ("base_mass", (-100.0, 0.0), "base_mass must be above -6.43, got"),
        ("base_mass", (-6.43, 0.0), "base_mass must be above -6.43, got"),
        *((row, (0.0, 1.0), f"{row} must be above 0, got") for row in (
            "link_mass", "gains", "no_load_speed", "cutoff_speed", "armature",
        )),
        *((row, (-0.1, 1.0), f"{row} must not be negative, got") for row in (
            "static_friction", "dynamic_friction", "motor_friction", "latency",
        )),
    ],
)  # fmt: skip
def test_ranges_that_reach_what_no_robot_has_are_refused(row, value, message):
    with pytest.raises(ValueError, match=message):
        RandomizationCfg(**{row: value})


def test_a_world_without_friction_is_finite():
    found = read(randomized(dataclasses.replace(OFF, static_friction=(0.5, 1.0), dynamic_friction=(0.0, 0.0)), 4))
    for name in ("dynamic_friction", "static_friction"):
        assert (found[name] <= 1.001e-4).all(), name  # the solver's least


@pytest.mark.parametrize("value", [(1.0, 0.5), (math.nan, 1.0), (0.0, math.inf)])
def test_impossible_ranges_are_refused(value):
    with pytest.raises(ValueError, match="base_mass"):
        RandomizationCfg(base_mass=value)

import dataclasses
import math

import numpy as np
import pytest
import torch
import warp as wp
from jump_helpers import DEG, edit_coordinates, edit_episodes, make_env, only, random_actions, resetting
from newton.solvers import SolverMuJoCo

from jumper_warp.envs.env import Env
from jumper_warp.registry import make_task
from jumper_warp.sim.simulation import Simulation
from jumper_warp.sim.solver import SolverJumper
from jumper_warp.tasks.randomization import RandomizationCfg
from kernels import layout
from kernels.jump.state import LANDED
from kernels.mdp.observations import drawn_push

N = 64
TASK = make_task("vertical-jump")
OFF = RandomizationCfg.off()
OF_MODEL = (
    "base_mass", "base_moments", "link_mass", "link_moments", "com_shift", "armature", "motor_friction",
)  # fmt: skip
MOTOR_DOFS = np.array([6 + 5 * leg + joint for leg in range(4) for joint in (0, 1, 3)])
PAPER = {
    "static_friction": (0.9, 1.2), "dynamic_friction": (0.8, 0.9), "base_mass": (-1.0, 2.0), "link_mass": (0.8, 1.2),
    "com_shift": (-0.03, 0.03), "gains": (0.6, 1.4), "no_load_speed": (0.8, 1.2), "cutoff_speed": (0.8, 1.4),
    "motor_friction": (0.005, 0.04), "armature": (0.6, 1.4), "joint_offset": (-2.0, 2.0), "latency": (0.0, 16.0),
    "force": (-5.0, 5.0), "torque": (-3.0, 3.0),
}  # fmt: skip
"""Table V, jumping."""
WALKING = PAPER | {
    "static_friction": (0.8, 0.95), "dynamic_friction": (0.7, 0.8), "no_load_speed": (0.6, 1.2),
    "cutoff_speed": (0.6, 1.4), "motor_friction": (0.0, 0.04), "latency": (0.0, 32.0),
    "observation_latency": (0.0, 32.0), "force": (-10.0, 10.0),
}  # fmt: skip
"""Table V, walking; the text adds that its latency applies to observations too."""
BEYOND = {
    "observation_latency": None, "push_interval": None, "push_share": 1.0, "push_in_flight": False, "redraw": "reset",
}  # fmt: skip
"""What the table does not tell, for jumping."""
ALL = PAPER | {"observation_latency": (0.0, 16.0)}
"""Every row."""


def randomized(cfg, num_envs=N, **arguments):
    task = resetting(dataclasses.replace(TASK, randomization=cfg), only("default"))
    return make_env(num_envs, task=task, **({"randomize": True} | arguments))


def read(env):
    """Return every randomised parameter as the solver, the motors and the environment have it; worlds come last."""
    n, table = env.num_envs, env.sim.physics.dynamics.robot.table.numpy().astype(float)
    legs = np.array([leg * layout.LEG_ROWS for leg in range(4)])
    links = np.array([[leg + link * layout.MOMENT_ROWS for link in range(5)] for leg in legs]).ravel()
    base, motors, parameters = int(layout.BASE), env.sim.motors, env.parameters
    moments = table[links[:, None] + np.arange(10)].reshape(20, 10, n)
    three = (legs[:, None] + np.arange(3)).ravel()
    return {
        "static_friction": table[legs + int(layout.MU_STATIC)],
        "dynamic_friction": table[legs + int(layout.MU_DYNAMIC)],
        "base_mass": table[base],
        "base_moments": table[base : base + 10],
        "link_mass": moments[:, 0],
        "link_moments": moments,
        "com_shift": table[base + 1 : base + 4] / table[base],
        "armature": table[three + int(layout.ARMATURE)],
        "motor_friction": table[three + int(layout.FRICTION)],
        **{name: getattr(motors, name).numpy().astype(float) for name in ("kp", "kd", "no_load_speed", "cutoff_speed")},
        "joint_offset": motors.offset.numpy().astype(float),
        "latency": parameters.latency.numpy().astype(float),
        "observation_latency": parameters.observation_latency.numpy().astype(float),
        "force": parameters.push.numpy()[:, :3].T.astype(float),
        "torque": parameters.push.numpy()[:, 3:].T.astype(float),
    }


@pytest.fixture(scope="module")
def nominal():
    """Parameters with every row off."""
    return read(randomized(OFF))


@pytest.fixture(scope="module")
def drawn():
    """Parameters with every row on, in 512 worlds."""
    return read(randomized(RandomizationCfg(observation_latency=(0.0, 16.0)), 512))


def within(values, lower, upper):
    """Whether values stay in a range, but for rounding."""
    width = upper - lower
    return values.min() >= lower - 1e-5 * width and values.max() <= upper + 1e-5 * width


def fills(values, lower, upper):
    """Whether values stay in a range, reach its ends and lie about its middle."""
    width = upper - lower
    wide = values.min() < lower + 0.03 * width and values.max() > upper - 0.03 * width
    return within(values, lower, upper) and wide and abs(values.mean() - 0.5 * (lower + upper)) < 0.1 * width


def test_the_ranges_are_the_papers():
    assert vars(RandomizationCfg()) == PAPER | BEYOND
    walking = vars(RandomizationCfg.walking())
    assert {name: walking[name] for name in WALKING} == WALKING
    assert set(walking) == {*PAPER, *BEYOND}


def test_off_is_the_robot_as_described(nominal):
    first = {name: values[..., :1] for name, values in nominal.items()}
    for name, values in nominal.items():
        np.testing.assert_array_equal(values, np.broadcast_to(first[name], values.shape), err_msg=name)
    for name in ("joint_offset", "latency", "observation_latency", "force", "torque"):
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
        drawn["torque"], drawn["dynamic_friction"][:1], drawn["latency"][None], drawn["observation_latency"][None],
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
    for name in ("latency", "observation_latency"):
        assert set(np.unique(drawn[name])) == set(range(8))


@pytest.mark.parametrize("steps", [1, 8, 13])  # the last is 12.999999999999998 in floating point
def test_a_latency_of_whole_physics_steps_is_kept(steps):
    exactly = (1000.0 * steps / 480.0,) * 2
    env = randomized(dataclasses.replace(OFF, latency=exactly, observation_latency=exactly), 2)
    assert env.parameters.latency.numpy().tolist() == [steps] * 2
    assert env.parameters.observation_latency.numpy().tolist() == [steps] * 2


def test_a_link_gains_mass_and_inertia_alike(drawn, nominal):
    scale = drawn["link_mass"] / nominal["link_mass"][:, :1]
    expected = nominal["link_moments"][..., :1] * scale[:, None, :]
    np.testing.assert_allclose(drawn["link_moments"], expected, rtol=1e-4, atol=1e-8)


AFFECTED = {
    "base_mass": ["base_mass", "base_moments"],
    "com_shift": ["com_shift", "base_moments"],
    "static_friction": ["static_friction"],
    "dynamic_friction": ["dynamic_friction", "static_friction"],
    "gains": ["kp", "kd"],
    "link_mass": ["link_mass", "link_moments"],
}


def same(name, found, expected):
    """Whether values are the same, bit for bit, but for the quotient of two of them."""
    return (
        np.allclose(found, expected, rtol=1e-6, atol=1e-9) if name == "com_shift" else np.array_equal(found, expected)
    )


@pytest.mark.parametrize("row", ALL)
def test_a_row_alone_changes_nothing_else(nominal, row):
    """Not one bit, but of rows that are drawn together."""
    found = read(randomized(dataclasses.replace(OFF, **{row: ALL[row]}), 4))
    nominal = {name: values[..., :4] for name, values in nominal.items()}
    changed = [name for name in found if not same(name, found[name], nominal[name])]
    allowed = AFFECTED.get(row, [row])
    assert set(changed) <= set(allowed) and allowed[0] in changed


@pytest.mark.parametrize("row", ALL)
def test_a_row_off_is_nominal(nominal, row):
    found = read(randomized(dataclasses.replace(RandomizationCfg(**ALL), **{row: None}), 4))
    for name in AFFECTED.get(row, [row])[:1]:
        if row == "static_friction":
            np.testing.assert_allclose(found[name], found["dynamic_friction"])
        elif row == "dynamic_friction":
            np.testing.assert_allclose(found[name], np.broadcast_to(found[name][:1, :1], found[name].shape))
        else:
            assert same(name, found[name], nominal[name][..., :4])


def test_the_same_seed_draws_the_same_and_another_does_not():
    one, same, other = (read(randomized(RandomizationCfg(**ALL), 8, seed=seed)) for seed in (3, 3, 4))
    for name in one:
        np.testing.assert_array_equal(one[name], same[name], err_msg=name)
        assert not np.array_equal(one[name], other[name]), name


# ---------------------------------------------------------------- when


def test_drawing_again_begins_with_the_nominal_values(nominal):
    env = randomized(RandomizationCfg(**ALL))
    before = read(env)
    for _ in range(3):
        env.reset()
    after = read(env)
    then = {name: values[..., :1] for name, values in nominal.items()}
    for row, value in ROWS.items():
        assert not np.array_equal(value(before, then), value(after, then)), row
        assert within(value(after, then), *ALL[row]), row


def seen(env):
    """Return what `read` does, but on MuJoCo without what `own_model` tells."""
    left_out = [] if isinstance(env.sim.solver, SolverJumper) else OF_MODEL
    return {name: values for name, values in read(env).items() if name not in left_out}


@pytest.mark.parametrize("solver", ["jumper", "mujoco"])
def test_a_world_draws_anew_at_its_reset_and_at_no_other_time(solver):
    """Over 30 steps of random actions, in which some worlds end by themselves."""
    env = randomized(RandomizationCfg(**ALL), 12, solver=solver)
    ended = np.zeros(12, dtype=bool)
    for step, action in enumerate(random_actions(12, 30)):
        before, of_solver = seen(env), own_model(env)
        if step % 10 == 9:
            edit_episodes(env, step // 10, phase=LANDED, phase_steps=59)
        env.step(action)
        after, done = seen(env), env.done.numpy() == 1.0
        for name in before:
            changed = (before[name] != after[name]).reshape(-1, 12).any(axis=0)
            np.testing.assert_array_equal(changed & ~done, False, err_msg=name)
            if name not in ("latency", "observation_latency"):  # whole numbers may be drawn twice
                np.testing.assert_array_equal(changed, done, err_msg=name)
        for name, values in own_model(env).items():
            changed = (values != of_solver[name]).reshape(12, -1).any(axis=1)
            np.testing.assert_array_equal(changed, done, err_msg=name)
        ended |= done
    assert ended[:3].all() and not ended.all()


@pytest.mark.parametrize("solver", ["jumper", "mujoco"])
def test_drawn_at_the_start_stays(solver):
    env = randomized(RandomizationCfg(**ALL, redraw="startup"), 4, solver=solver)
    first, of_solver = seen(env), own_model(env)
    assert len(np.unique(env.sim.model.body_mass.numpy())) == 84
    for action in random_actions(4, 3):
        edit_episodes(env, slice(0, 2), phase=LANDED, phase_steps=59)
        env.step(action)
        assert env.done[:2].all()
    env.reset()
    found = seen(env)
    for name in first:
        if name in ("force", "torque"):  # a push is of an episode
            assert not np.array_equal(found[name], first[name])
        else:
            np.testing.assert_array_equal(found[name], first[name], err_msg=name)
    for name, values in own_model(env).items():
        np.testing.assert_array_equal(values, of_solver[name], err_msg=name)


def test_an_evaluation_draws_for_its_worlds_only():
    env = randomized(RandomizationCfg(**ALL), 6)
    before, chosen = read(env), np.arange(6) % 2 == 0
    env.evaluation_reset(np.zeros((6, 4)), worlds=chosen)
    after = read(env)
    for name in ("link_mass", "kp", "joint_offset", "force"):
        changed = (before[name] != after[name]).any(axis=0)
        np.testing.assert_array_equal(changed, chosen, err_msg=name)


def test_pushes_of_walking_come_and_go():
    """In a quarter of the intervals, of 0.2 to 0.5 s each, in flight too."""
    task = dataclasses.replace(TASK, randomization=RandomizationCfg.walking())
    env = make_env(48, task=resetting(task, only("default")), randomize=True)
    env.auto_reset = False
    pushes = []
    for _ in range(300):
        env.step(torch.zeros((48, 12)))
        pushes.append(env.parameters.push.numpy().copy())
        np.testing.assert_array_equal(env.sim.state.body_f.numpy().reshape(48, 21, 6)[:, 0], pushes[-2:][0])
    pushes = np.array(pushes)
    on = pushes.any(axis=2)
    assert 0.2 < on.mean() < 0.3
    longest, changes = 0, 0
    for world in range(48):
        edges = np.flatnonzero((pushes[1:, world] != pushes[:-1, world]).any(axis=1))
        gaps = np.diff(edges)  # [policy steps]
        assert gaps.min(initial=12) >= 12
        lasted = [gap for gap, at in zip(gaps, edges, strict=False) if on[at + 1, world]]
        longest, changes = max([longest, *lasted]), changes + len(edges)
    assert longest <= 30 and changes > 200
    found = pushes[on]
    assert fills(found[:, :3], -10.0, 10.0) and fills(found[:, 3:], -3.0, 3.0)


def test_a_push_begins_with_an_episode_and_is_what_the_critic_sees():
    env = randomized(dataclasses.replace(OFF, force=(-5.0, 5.0), torque=(-3.0, 3.0)), 4)
    first, last = env.task.layout("critic")[drawn_push.key.split(".")[-1]]
    for _ in range(2):
        push = env.parameters.push.numpy().copy()
        np.testing.assert_allclose(env.critic_obs[:, first:last], push / [5.0, 5.0, 5.0, 3.0, 3.0, 3.0], rtol=1e-6)
        edit_episodes(env, phase=LANDED, phase_steps=59)
        env.step(torch.zeros((4, 12)))
        assert env.done.all() and not (env.parameters.push.numpy() == push).any()


# ---------------------------------------------------------------- MuJoCo


def own_model(env: Env) -> dict[str, np.ndarray]:
    """Return what randomisation changes of SolverMuJoCo's own model, the world first; nothing on SolverJumper."""
    if not isinstance(env.sim.solver, SolverMuJoCo):
        return {}
    model = env.sim.solver.mjw_model
    names = ("body_mass", "body_inertia", "body_ipos", "dof_armature", "dof_frictionloss", "geom_friction")
    return {name: getattr(model, name).numpy().copy() for name in names}


def test_it_reaches_mujoco_too():
    env = randomized(RandomizationCfg(), 2, solver="mujoco")
    for _ in range(2):
        model, solver, found = env.sim.model, env.sim.solver.mjw_model, own_model(env)
        bodies = {name: getattr(model, name).numpy().reshape(2, 21, -1) for name in ("body_mass", "body_com")}
        np.testing.assert_allclose(found["body_mass"][:, 1:], bodies["body_mass"][..., 0], rtol=1e-6)
        np.testing.assert_allclose(found["body_ipos"][:, 1:], bodies["body_com"], atol=1e-7)
        # MuJoCo keeps principal moments, in an order of its own
        inertia = np.linalg.eigvalsh(model.body_inertia.numpy().astype(float)).reshape(2, 21, 3)
        np.testing.assert_allclose(np.sort(found["body_inertia"][:, 1:], axis=2), inertia, rtol=1e-3, atol=1e-9)
        for world in range(2):
            for name, least, wanted in (
                ("dof_armature", 1e-3, model.joint_armature), ("dof_frictionloss", 1e-6, model.joint_friction),
            ):  # fmt: skip
                row = found[name][world]
                motors = wanted.numpy().reshape(2, -1)[world][MOTOR_DOFS]
                np.testing.assert_allclose(np.sort(row[row > least]), np.sort(motors), rtol=1e-5)
            paws = model.shape_material_mu.numpy()[env.parameters.paw_shapes.numpy().reshape(2, 4)[world]]
            assert np.isclose(found["geom_friction"][world, :, 0][:, None], paws).any(axis=0).all()
        assert solver is env.sim.solver.mjw_model
        env.reset()
        assert all((found[name] != values).any() for name, values in own_model(env).items())


# ---------------------------------------------------------------- what they do


@pytest.mark.parametrize("in_flight", [False, True])
def test_pushes_act_on_the_ground_only_or_in_flight_too(in_flight):
    cfg = dataclasses.replace(OFF, force=PAPER["force"], torque=PAPER["torque"], push_in_flight=in_flight)
    env = randomized(cfg, 9)
    push = env.parameters.push.numpy()
    for world in range(3, 6):
        edit_coordinates(env, world, q={2: 1.0})
    rest = torch.zeros((9, 12))
    edit_episodes(env, command_step=1000)
    env.auto_reset = False
    for _ in range(2):  # in the first, the paws of all were last seen in the air
        env.step(rest)
        wrench = env.sim.state.body_f.numpy().reshape(9, 21, 6)
    np.testing.assert_array_equal(wrench[[0, 1, 2, 6, 7, 8], 0], push[[0, 1, 2, 6, 7, 8]])
    np.testing.assert_array_equal(wrench[3:6, 0], in_flight * push[3:6])
    assert not wrench[:, 1:].any()


def test_a_push_accelerates_the_robot():
    """Lifted off the ground but still counted as standing: momentum grows by force times time."""
    env = randomized(OFF, 2)
    push = np.zeros((2, 6))
    push[1, :3] = [4.0, -3.0, 5.0]
    env.parameters.push.assign(push.astype(np.float32))
    q = env.sim.joint_q().copy()
    q[:, 2] += 0.5
    env.sim.state.joint_q.assign(q.ravel())
    env.robot.contact_time.fill_(1.0)
    env.step(torch.zeros((2, 12)))
    env.sim.physics.write_bodies()
    velocity = env.sim.state.body_qd.numpy().reshape(2, 21, 6)[..., :3].astype(float)
    momentum = (env.sim.model.body_mass.numpy().reshape(2, 21, 1) * velocity).sum(axis=1)
    np.testing.assert_allclose(momentum[1] - momentum[0], np.array([4.0, -3.0, 5.0]) / 60.0, atol=2e-3)


def test_a_sensor_offset_acts_on_the_motor_and_on_the_observation():
    """A motor whose sensor reads too high by d ends where an honest one told to go d lower does."""
    wrong, honest = randomized(OFF, 1), randomized(OFF, 1)
    offset = np.zeros((12, 1), dtype=np.float32)
    offset[4] = 2.0 * DEG
    wrong.parameters.motors.offset.assign(offset)
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
    env.parameters.motors.offset.assign(offset)
    for world in range(2):
        edit_coordinates(env, world, q={13: 97.0 * DEG, 15: 97.0 * DEG})
    env.auto_reset = False
    env.step(torch.ones((2, 12)))  # 135 degrees each, 30 more than the sum may be
    safe = env.robot.safe_target.numpy()[4:6] / DEG
    np.testing.assert_allclose(safe, [[135.0, 120.0], [135.0, 120.0]], atol=1e-3)


def test_motor_and_observation_share_their_sensor():
    env = randomized(RandomizationCfg(), 2)
    assert env.sim.motors.offset.ptr == env.robot.joint_offset.ptr == env.parameters.motors.offset.ptr
    assert env.sim.motors.offset.numpy().all()


def test_an_action_arrives_after_its_delay():
    """Against the same robot driven step by step, its motors told the old targets until the new ones arrive."""
    delays = np.array([0, 1, 3, 5, 8, 13])
    env = randomized(OFF, len(delays))
    env.parameters.latency.assign(delays.astype(np.int32))
    sim = Simulation(len(delays), motors=TASK.motors, friction=0.9, visuals=False, device="cpu")
    sim.state.joint_q.assign(env.sim.state.joint_q)
    targets = [env.robot.safe_target.numpy().copy()] * 2
    generator = torch.Generator().manual_seed(5)
    spread = []
    for _ in range(6):
        env.step(0.4 * (2.0 * torch.rand((1, 12), generator=generator) - 1.0).repeat(len(delays), 1))
        targets.append(env.robot.safe_target.numpy().copy())
        for step in range(8):
            age = np.ceil((delays - step) / 8.0).clip(0.0).astype(int)  # policy steps since the target that acts
            now = np.stack([targets[-1 - age[world]][:, world] for world in range(len(delays))], axis=1)
            sim.physics.advance(1, wp.array(now, dtype=float, device="cpu"))
        np.testing.assert_allclose(env.sim.joint_q()[:, :7], sim.joint_q()[:, :7], atol=2e-4)
        np.testing.assert_allclose(env.sim.joint_qd()[:, MOTOR_DOFS], sim.joint_qd()[:, MOTOR_DOFS], atol=5e-2)
        spread.append(np.abs(np.diff(env.sim.joint_qd()[:, MOTOR_DOFS], axis=0)).max(axis=1))
    assert np.min(np.max(spread, axis=0)) > 0.5  # [rad/s] each delay differs from the next


@pytest.mark.parametrize("value", [(1.0, 0.5), (math.nan, 1.0), (0.0, math.inf)])
def test_impossible_ranges_are_refused(value):
    with pytest.raises(ValueError, match="base_mass"):
        RandomizationCfg(base_mass=value)

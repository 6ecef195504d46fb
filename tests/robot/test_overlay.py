"""Robot overlays: as files, in simulations on both solvers, and in environments."""

import json

import numpy as np
import pytest

from jumper_warp.envs.env import Env
from jumper_warp.kernels.layout import BODIES, DOFS
from jumper_warp.registry import make_task
from jumper_warp.robot.overlay import RANDOMIZED, RobotOverlay, load_overlay
from jumper_warp.sim.simulation import Simulation
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.utils.errors import InputError

VALUES = {
    "base_mass": (7.0,), "base_com": (0.01, 0.0, 0.02), "link_mass": (1.1, 1.0, 1.0, 1.0, 0.9),
    "kp": (1.2,) + 11 * (0.9,),
    "offset": (0.02,) + 11 * (-0.01,), "armature": 12 * (0.005,), "knee_damping": (0.2,), "paw_friction": (0.7,),
    "latency": (0.0042,), "no_load_speed": 12 * (44.0,),
}  # fmt: skip
RANGES = {"base_mass": (-0.1, 0.1), "joint_offset": (-0.2, 0.2), "latency": (3.0, 5.0)}  # [kg], [deg], [ms]


def test_load_overlay_inverts_save(tmp_path):
    overlay = RobotOverlay(VALUES, RANGES, "a bench")
    overlay.save(tmp_path / "robot.json")
    loaded = load_overlay(tmp_path / "robot.json")
    assert loaded.to_json() == overlay.to_json()
    assert loaded.robots().kp[0, 0] == 1.2 and loaded.robots().kd[0, 0] == 1.0  # kd: the default


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"values": {"colour": [1.0]}}, "unknown quantity 'colour'"),
        ({"values": {"kp": [1.0]}}, r"kp needs 12 values, got shape \(1,\)"),
        ({"values": {"base_mass": [7000.0]}}, "base_mass must be in 0.001 to 100 kg"),
        ({"value": {"kp": 12 * [1.1]}}, "unknown section 'value'; expected one of schema, source, robot, values"),
        ({"values": {"cutoff_speed": 12 * [60.0]}}, "below the no_load_speed"),
    ],
)
def test_refuses_bad_overlay_in_one_line(tmp_path, change, message):
    file = tmp_path / "robot.json"
    file.write_text(json.dumps(RobotOverlay(VALUES).to_json() | change))
    with pytest.raises(InputError, match=message) as refusal:
        load_overlay(file)
    assert str(refusal.value).startswith(str(file)) and "\n" not in str(refusal.value)


def test_overlay_accepts_the_ranges_of_randomization_cfg():
    assert set(RANDOMIZED) == {name for name, value in vars(RandomizationCfg.off()).items() if value is None}


@pytest.mark.parametrize("solver", ["jumper", "mujoco"])
def test_simulation_uses_overlay_values(solver):
    sim = Simulation(2, solver=solver, visuals=False, robot=RobotOverlay(VALUES))
    plain = Simulation(2, visuals=False)
    mass, described = (s.model.body_mass.numpy().reshape(2, int(BODIES)) for s in (sim, plain))
    assert mass[:, 0] == pytest.approx([7.0, 7.0])
    np.testing.assert_allclose(mass[:, 1:6] / described[:, 1:6], [[1.1, 1.0, 1.0, 1.0, 0.9]] * 2, rtol=1e-6)
    inertia, described = (s.model.body_inertia.numpy()[1] for s in (sim, plain))  # FL housing of world 0
    np.testing.assert_allclose(inertia, 1.1 * described, rtol=1e-5)
    scale = sim.motors.kp.numpy() / plain.motors.kp.numpy()
    np.testing.assert_allclose(scale, np.repeat(np.array(VALUES["kp"])[:, None], 2, axis=1), rtol=1e-6)
    np.testing.assert_allclose(sim.motors.offset.numpy()[:, 0], VALUES["offset"], rtol=1e-6)
    assert sim.model.joint_armature.numpy().reshape(2, int(DOFS))[1, 6] == pytest.approx(0.005)  # FL lateral
    if solver == "jumper":
        table = sim.dynamics.robot.table.numpy()
        assert table[:, 0] == pytest.approx(table[:, 1])
        assert np.isclose(table, 0.7).sum() >= 16  # both coefficients of four paws in two worlds


def test_environment_randomises_around_overlay_and_saves_it():
    overlay = RobotOverlay(VALUES, RANGES)
    task = make_task("vertical-jump")
    nominal = Env(task, 2, randomize=False, noise=False, robot=overlay, device="cpu")
    assert nominal.parameters.latency.numpy().tolist() == [2, 2]  # physics steps: 4.2 ms of 1/480 s
    assert nominal.parameters.nominal_kp.numpy()[0, 0] == pytest.approx(1.2 * task.motors.lateral.kp)
    assert RobotOverlay.from_json(nominal.config()["robot"]).values["kp"] == VALUES["kp"]
    env = Env(task, 16, noise=False, robot=overlay, device="cpu")
    env.reset()
    mass = env.sim.model.body_mass.numpy().reshape(16, -1)[:, 0]
    assert 6.9 <= mass.min() < mass.max() <= 7.1
    offset = np.degrees(env.sim.motors.offset.numpy() - np.array(VALUES["offset"])[:, None])
    assert np.abs(offset).max() <= 0.2 + 1e-5 and np.ptp(offset) > 0.2
    assert set(env.parameters.latency.numpy()) <= {1, 2}  # 3 to 5 ms


def test_worlds_have_the_motors_of_their_robots_in_turn():
    task = make_task("vertical-jump")
    speeds = {"no_load_speed": tuple(12 * [30.0]), "cutoff_speed": tuple(12 * [15.0])}
    weak = {"kp": tuple(12 * [1.5]), "saturation": tuple(12 * [0.5]), "offset": tuple(12 * [0.1]), **speeds}
    robots = [RobotOverlay({}), RobotOverlay({**weak, "latency": (0.05,)})]
    env = Env(task, 4, randomize=False, noise=False, robot=robots, device="cpu")
    env.reset()
    assert env.parameters.latency.numpy().tolist() == [0, 24, 0, 24]  # physics steps
    alone = [Env(task, 1, randomize=False, noise=False, robot=robot, device="cpu") for robot in robots]
    for one in alone:
        one.reset()
    for name in ("kp", "kd", "saturation", "no_load_speed", "cutoff_speed", "offset"):
        expected = np.hstack([getattr(one.sim.motors, name).numpy() for one in alone])
        np.testing.assert_array_equal(getattr(env.sim.motors, name).numpy(), np.tile(expected, (1, 2)), name)
    with pytest.raises(InputError, match="same latency"):
        Env(task, 4, robot=robots, device="cpu")


def test_overlay_accepts_the_described_armature_of_a_locked_axis():
    """An armature that differs from the description stays limited."""
    robot = load_overlay("small_direct_drive")
    armature = robot.robots().armature[0]
    assert armature[0] > 1.0  # [kg m^2] above the range
    np.testing.assert_array_equal(
        RobotOverlay({"armature": tuple(armature)}, robot=robot.robot).robots().armature[0], armature
    )
    with pytest.raises(InputError, match="armature must be in"):
        RobotOverlay({"armature": tuple(2.0 * armature)}, robot=robot.robot)

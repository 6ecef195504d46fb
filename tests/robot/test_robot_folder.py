"""Robots from tables: reading, refusals, lengths of overlays, and their dynamics and kinematics against Pinocchio."""

import copy

import numpy as np
import pytest
import warp as wp

from dynamics_oracle import differences, jumper_quantities, pinocchio_quantities, random_states
from jumper_warp.kernels.kinematics.inverse import LegLimits
from jumper_warp.robot.description import load_description
from jumper_warp.robot.export import export_robot
from jumper_warp.robot.folder import LOCKED, read_robot, read_urdf, robot_of, table_of, write_robot
from jumper_warp.robot.legs import leg_dimensions
from jumper_warp.robot.measures import filter_for
from jumper_warp.robot.motors import walking_filter
from jumper_warp.robot.overlay import RobotOverlay, load_overlay
from jumper_warp.robot.plausible import facts
from jumper_warp.robot.values import RobotValues, described
from jumper_warp.sim.simulation import Simulation
from jumper_warp.utils.errors import InputError
from leg_kernels import make_inverse_kernel, make_leg_kernel
from odd_robot import odd_table, set_value


def test_table_of_the_jumper_gives_the_jumper_again(tmp_path):
    jumper = load_description()
    write_robot(tmp_path, table_of(jumper, "CAD"))
    robot = robot_of(read_robot(tmp_path))
    for ours, theirs in zip(robot.links, jumper.links, strict=True):
        assert ours.mass == theirs.mass and np.allclose(ours.com, theirs.com, atol=0.0)
        assert np.allclose(ours.inertia, theirs.inertia, atol=0.0)
    motions = []
    for overlay in (None, load_overlay(tmp_path)):
        sim = Simulation(1, robot=overlay, device="cpu", visuals=False)
        sim.set_targets(np.tile([0.1, 1.2, 0.9], 4))
        for _ in range(10):
            sim.step()
        motions.append(sim.joint_q())
    np.testing.assert_array_equal(motions[0], motions[1])


def test_dynamics_of_unequal_legs_agree_with_pinocchio():
    overlay = RobotOverlay({}, robot=odd_table())
    values, robot = overlay.robots(), overlay.description
    states = random_states(8, 0, robot)
    ours, theirs = (of(values, states, robot) for of in (jumper_quantities, pinocchio_quantities))
    assert max(differences(ours[name], theirs[name])[1] for name in ours) < 1.0e-6


def test_inverse_kinematics_bring_paws_beyond_their_ankles_to_their_targets():
    overlay = RobotOverlay({}, robot=odd_table())
    sim = Simulation(1, robot=overlay, device="cpu", visuals=False)
    geometry = sim.dynamics.robot.geometry
    angles = random_states(20, 1, overlay.description)["angles"].T
    package = "jumper_warp.kernels"
    paws, *rest = (wp.zeros((4, 20), dtype=kind, device="cpu") for kind in (wp.vec3, wp.vec2, wp.vec3, wp.vec2))
    inputs = [geometry, wp.array(angles, dtype=float, device="cpu"), wp.zeros((4, 20), dtype=wp.vec3, device="cpu")]
    wp.launch(make_leg_kernel(package), (4, 20), inputs, [paws, *rest], device="cpu")
    oracle = pinocchio_quantities(overlay.robots(), random_states(20, 1, overlay.description), overlay.description)
    np.testing.assert_allclose(paws.numpy(), oracle["paw_position"].transpose(1, 0, 2), atol=1.0e-6)
    limits = LegLimits()
    for name in ("lateral", "transversal", "sum"):
        setattr(limits, f"{name}_lower", -1.0 if name != "sum" else 0.0)
        setattr(limits, f"{name}_upper", 2.5 if name != "sum" else 4.5)
    found = wp.zeros((12, 20), dtype=float, device="cpu")
    wp.launch(make_inverse_kernel(package), (4, 20), [geometry, limits, paws], [found], device="cpu")
    np.testing.assert_allclose(found.numpy(), angles, atol=2.0e-5)


def test_overlay_of_lengths_changes_the_geometry_and_keeps_masses(tmp_path):
    overlay = RobotOverlay({"shank_length": (0.32,), "thigh_length": (0.18, 0.17), "base_mass": (7.93,)})
    overlay.save(tmp_path / "long.json")
    robot = load_overlay(tmp_path / "long.json").description
    assert [loop.parent_anchor[2] for loop in robot.loops] == 4 * [-0.32]
    assert [robot.joint(f"{leg}_outer_knee").origin[2] for leg in ("FL", "FR", "BL", "BR")] == [
        -0.18,
        -0.18,
        -0.17,
        -0.17,
    ]
    assert robot.mass == pytest.approx(14.5)
    assert described(overlay.robots(), robot).mass == pytest.approx(16.0)
    assert not overlay.is_jumper and RobotOverlay({"base_mass": (7.93,)}).is_jumper


def test_overlay_of_lengths_stretches_legs_with_values_of_their_own():
    """FR's thigh is 0.02 m longer, and the mass of BL's outer thigh at the hip; both scale with their leg."""
    table = table_of(load_description(), "Jumper")
    usual = table["front"]["thigh"]["value"]
    table["FR"] = {"thigh": {**table["front"]["thigh"], "value": usual + 0.02}}
    table["BL"] = {"outer_thigh_com": {**table["back"]["outer_thigh_com"], "value": [0.0, 0.0, -0.01]}}
    robot = RobotOverlay({"thigh_length": (2.0 * usual,)}, robot=table).description
    knees = [robot.joint(f"{leg}_outer_knee").origin[2] for leg in ("FL", "FR", "BL", "BR")]
    assert knees == pytest.approx(4 * [-2.0 * usual])
    coms = [robot.link(f"{leg}_outer_thigh").com[2] for leg in ("FL", "FR", "BL")]
    assert coms[1] / coms[0] == pytest.approx(usual / (usual + 0.02)) and coms[2] == pytest.approx(-0.02)


def test_overlay_of_lengths_of_a_robot_without_legs_names_the_section():
    with pytest.raises(InputError, match="section 'front' is missing"):
        RobotOverlay({"thigh_length": (0.2,)}, robot={**odd_table(), "front": None})


def test_motors_of_the_back_legs_have_their_own_torque_and_gains():
    overlay = RobotOverlay({}, robot=odd_table())
    sim = Simulation(1, robot=overlay, device="cpu", visuals=False)
    saturation, kp, peak = (getattr(sim.motors, name).numpy()[:, 0] for name in ("saturation", "kp", "peak"))
    assert saturation[[1, 7]] == pytest.approx([18.0, 9.0]) and kp[[1, 7]] == pytest.approx([17.0, 12.0])
    assert peak[[1, 7]] == pytest.approx([24.8, 12.4])
    again = described(RobotValues.nominal(1, overlay.description), overlay.description)
    assert [motor.peak_torque for motor in again.motors] == [motor.peak_torque for motor in overlay.description.motors]


def test_worlds_take_robots_in_turn_and_move_as_each_alone():
    tables = [odd_table(), odd_table()]
    set_value(tables[1]["front"], "inner_shank", 0.3)
    robots = [RobotOverlay({}, robot=table) for table in tables]
    motions = []
    for one in (robots, robots[0], robots[1]):
        sim = Simulation(4, robot=one, device="cpu", visuals=False)
        sim.set_targets(np.tile([0.05, 1.3, 1.1], 4))
        for _ in range(30):
            sim.step()
        motions.append(np.hstack([sim.joint_q(), sim.joint_qd()]))
    np.testing.assert_array_equal(motions[0][::2], motions[1][::2])
    np.testing.assert_array_equal(motions[0][1::2], motions[2][1::2])
    assert np.abs(motions[0][0] - motions[0][1]).max() > 1.0e-3


def test_tighter_stops_of_the_back_legs_limit_filter_and_reach():
    table = table_of(load_description(), "test")
    set_value(table["back"], "transversal_stops", [-30.0, 100.0])
    table["BR"] = {"lateral_stops": {"value": [-40.0, 110.0], "unit": "deg", "source": "test"}}
    robot, usual = robot_of(table), walking_filter()
    limits = filter_for(usual, robot)
    assert (limits.transversal.lower, limits.transversal.upper) == pytest.approx((-30.0, 100.0))
    assert (limits.lateral.lower, limits.lateral.upper) == pytest.approx((-40.0, 110.0), abs=1.0e-3)
    reach = facts(robot)["reach below the hip"].split(", ")
    assert reach[0] == facts(load_description())["reach below the hip"].split(", ")[0]
    assert reach[1].startswith(f"{leg_dimensions(robot, 'BL').depth(0.0, np.radians(100.0)):.3f} to ")


def test_exported_urdf_is_read_as_the_same_robot(tmp_path):
    robot = robot_of(odd_table())
    read = read_urdf(export_robot("urdf", tmp_path, description=robot))
    for leg in ("front", "back"):
        ours, theirs = (table_of(one, "")[leg] for one in (robot, read))
        for name in ours:
            if not name.endswith("_motor"):
                assert ours[name]["value"] == pytest.approx(theirs[name]["value"], abs=1.0e-9), name


def test_motors_at_the_back_may_have_half_the_gains_or_a_locked_axis():
    table = odd_table()
    for name in ("kp_jumping", "kd_jumping", "kp_walking", "kd_walking"):
        set_value(table["motors"]["weak"], name, 0.5 * table["motors"]["AK70-10"][name]["value"])
    set_value(table["back"], "lateral_motor", "locked")
    assert robot_of(table).motors[6] == LOCKED


def test_motors_of_an_exported_urdf_keep_their_torque(tmp_path):
    table = table_of(read_urdf(export_robot("urdf", tmp_path, description=load_overlay("heavy").description)), "")
    motors = robot_of(table).motors
    assert [motors[i].peak_torque for i in (1, 2, 7, 11)] == pytest.approx([95.7793, 95.7793, 86.2014, 86.2014])
    assert {motor.type for motor in motors} == {"AK80-9", "AK70-10", "AK70-10 back"}


def test_exported_urdf_keeps_locked_axes(tmp_path):
    read = read_urdf(export_robot("urdf", tmp_path, description=load_overlay("small_direct_drive").description))
    assert RobotOverlay({}, robot=table_of(read, "")).description.motors[::3] == 4 * (LOCKED,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table.pop("back"), "section 'back' is missing: .* Newton or mjlab"),
        (lambda table: table.update(middle={}), "unknown section 'middle': .* Newton or mjlab"),
        (lambda table: table["front"].pop("outer_shank"), "front: outer_shank needs .* Newton or mjlab"),
        (lambda table: table["front"].update(knees={}), "front: unknown quantity 'knees'"),
        (lambda table: table["front"]["thigh"].update(unit="mm"), "front: the unit of thigh is m, got 'mm'"),
        (lambda table: set_value(table["front"], "hip", [0.1, 0.1]), "front: hip must be 3 finite numbers"),
        (lambda table: set_value(table["body"], "mass", 0.0), "body: mass must be 1 finite number, positive"),
        (lambda table: set_value(table["body"], "inertia", [-1, 1, 1, 0, 0, 0]), "body: the principal moments"),
        (lambda table: set_value(next(iter(table["motors"].values())), "peak_torque", 0.0), "peak_torque .* positive"),
        (lambda table: set_value(table["front"], "outer_shank", 0.01), "shanks of 0.01 and 0.28 m cannot connect"),
        (lambda table: set_value(table["back"], "lateral_motor", "none"), "BL lateral_motor: no motor 'none'"),
        (lambda table: set_value(table["motors"]["weak"], "kp_walking", 17.0), "motors weak: .* AK70-10 differ"),
        (lambda table: set_value(table["motors"]["weak"], "kd_jumping", 0.4), "motors weak: .* AK70-10 differ"),
    ],
)
def test_refuses_bad_table(change, message):
    table = copy.deepcopy(odd_table())
    change(table)
    with pytest.raises(InputError, match=message):
        robot_of(table)

"""Mutations of the project's description: each is refused with a message of one line, or gives a plausible robot."""

import json
import math
import shutil
import warnings
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from json_helpers import places
from jumper_warp.robot.description import DEFAULT_DESCRIPTION, RobotDescriptionError, load_description

JSON = json.loads(DEFAULT_DESCRIPTION.read_text())
FACTORS = [1e-30, 1e-6, 1e-3, -1.0, 1e3, 1e6, 1e30]  # wrong units and signs
NOT_FINITE = [math.nan, math.inf]
JUNK = ["", "x", "1 2 3 4", "body", [], {}, [1.0], True, None, 10**400, "\n", "nan"]


def urdf_with_visuals_of_one_leg():
    """Return the URDF's text without the visual shapes of all legs but FL, which makes loading faster."""
    root = ElementTree.parse(DEFAULT_DESCRIPTION.parent / "jumper.urdf").getroot()
    for link in root.findall("link"):
        if link.get("name")[:2] in ("FR", "BL", "BR"):
            for visual in link.findall("visual"):
                link.remove(visual)
    return ElementTree.tostring(root, encoding="unicode")


URDF = urdf_with_visuals_of_one_leg()


@pytest.fixture(scope="module")
def assets(tmp_path_factory):
    """Writable copy of the robot's folder, with a tetrahedron for each mesh."""
    folder = shutil.copytree(DEFAULT_DESCRIPTION.parent, tmp_path_factory.mktemp("robot") / "jumper")
    for mesh in (folder / "meshes").iterdir():
        mesh.write_text("v 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nv 0 0 -0.1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n")
    return folder


def numeric_attributes(root):
    """Yield (dict of the element's attributes, key in it, list of numbers) of each numeric attribute of an XML tree."""
    for element in root.iter():
        for name, text in element.attrib.items():
            try:
                yield element.attrib, name, [float(word) for word in text.split()]
            except ValueError:
                continue


def is_number(value):
    """Return whether a JSON value is a number."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def magnitudes():
    """Return the sorted absolute values, without 0, of all numbers in the URDF and the JSON file."""
    numbers = {abs(value) for _, _, values in numeric_attributes(ElementTree.fromstring(URDF)) for value in values}
    numbers |= {abs(table[key]) for table, key in places(JSON) if is_number(table[key])}
    return sorted(numbers - {0.0})


def change_everywhere(magnitude, change):
    """Return URDF and JSON text with change(x) for every number x of this magnitude, so that legs stay equal."""
    root = ElementTree.fromstring(URDF)
    for holder, name, values in numeric_attributes(root):
        if magnitude in map(abs, values):
            holder[name] = " ".join(repr(change(v) if abs(v) == magnitude else v) for v in values)
    tree = json.loads(json.dumps(JSON))
    for table, key in places(tree):
        if is_number(table[key]) and abs(table[key]) == magnitude:
            table[key] = change(table[key])
    return ElementTree.tostring(root, encoding="unicode"), json.dumps(tree)


def load(assets, urdf, text):
    """Return the description of URDF text and JSON text, or None after a refusal of one line; warnings are errors."""
    (assets / "jumper.urdf").write_text(urdf, encoding="utf-8")
    (assets / "jumper.json").write_text(text, encoding="utf-8")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return load_description(assets / "jumper.json")
    except RobotDescriptionError as error:
        assert "\n" not in str(error) and len(str(error)) < 1000
        return None


def assert_valid_robot(robot):
    """Assert that masses, lengths, torques, speeds and gains (SI units) are those of some legged robot."""
    for link in robot.links:
        assert 1e-3 <= link.mass <= 100.0
        assert np.abs(link.com).max() <= 2.0
        moments = np.linalg.eigvalsh(link.inertia)
        # radius of gyration from 1 mm to 3 m
        assert 1e-6 * link.mass <= moments[0] * 1.001 and moments[-1] <= 9.0 * link.mass
        for shape in (*link.visuals, *link.collisions):
            assert np.abs(shape.position).max() <= 2.0 and all(1e-4 <= size <= 2.0 for size in shape.size)
    for joint in robot.joints:
        assert np.abs(joint.origin).max() <= 2.0
        assert -6.3 < joint.lower < joint.upper < 6.3
        assert 0.0 < joint.effort <= 1e4 and 0.0 < joint.velocity <= 1e4
    for leg in ("FL", "FR", "BL", "BR"):
        assert -2.0 <= robot.joint(f"{leg}_outer_knee").origin[2] <= -1e-3
        assert 1e-3 <= robot.link(f"{leg}_inner_shank").collisions[0].size[0] <= 0.2
    for motor in robot.motors:
        assert 1.0 <= motor.gear_ratio <= 1000.0 and 1e-6 <= motor.armature <= 1.0
        assert 0.1 <= motor.peak_torque <= 1000.0 and 0.0 < motor.coulomb_friction <= min(10.0, motor.peak_torque)
        assert 0.1 <= motor.cutoff_speed < motor.no_load_speed <= 1000.0
        for gains in (motor.jumping, motor.walking):
            assert 0.1 <= gains.kp <= 1e4 and 1e-3 <= gains.kd <= 1e3
    assert 0.0 < robot.knee_damping <= 10.0 and 0.0 < robot.knee_damping_limit <= 1e3


def test_numbers_in_other_units_are_refused_or_give_a_valid_robot(assets):
    refused = 0
    for magnitude in magnitudes():
        for factor in FACTORS:
            robot = load(assets, *change_everywhere(magnitude, lambda value, factor=factor: value * factor))
            refused += robot is None
            if robot is not None:
                assert_valid_robot(robot)
    assert refused > 0.7 * len(magnitudes()) * len(FACTORS)


def test_refuses_non_finite_numbers(assets):
    for magnitude in magnitudes():
        for value in NOT_FINITE:
            assert load(assets, *change_everywhere(magnitude, lambda _, value=value: value)) is None, magnitude


@settings(max_examples=250, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_one_change_of_the_json_is_refused_or_gives_a_valid_robot(assets, data):
    tree = json.loads(json.dumps(JSON))
    table, key = data.draw(st.sampled_from(list(places(tree))))
    old = table[key]
    if data.draw(st.booleans()):
        table[key] = data.draw(st.sampled_from([*JUNK, *NOT_FINITE, 0, *(old * f for f in FACTORS if is_number(old))]))
    elif data.draw(st.booleans()):
        del table[key]
    elif isinstance(table, list):
        table.insert(key, old)
    else:
        table[f"{key} again"] = old
    robot = load(assets, URDF, json.dumps(tree))
    if robot is not None:
        assert_valid_robot(robot)


@settings(max_examples=250, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_one_change_of_the_urdf_is_refused_or_gives_a_valid_robot(assets, data):
    root = ElementTree.fromstring(URDF)
    slots = [(parent, index) for parent in root.iter() for index in range(len(parent))]
    parent, index = data.draw(st.sampled_from(slots))
    element = parent[index]
    kind = data.draw(st.sampled_from(["delete", "double", "attribute", "number"]))
    if kind == "delete":
        parent.remove(element)
    elif kind == "double":
        parent.insert(index, element)
    elif kind == "attribute" and element.attrib:
        name = data.draw(st.sampled_from(sorted(element.attrib)))
        element.attrib[name] = data.draw(st.sampled_from([text for text in JUNK if isinstance(text, str)]))
    else:
        holder, name, values = data.draw(st.sampled_from(list(numeric_attributes(root))))
        place = data.draw(st.integers(0, len(values) - 1)) if values else 0
        new = data.draw(st.sampled_from([*NOT_FINITE, 0.0, *(values[place] * factor for factor in FACTORS)]))
        holder[name] = " ".join(repr(new if i == place else value) for i, value in enumerate(values))
    robot = load(assets, ElementTree.tostring(root, encoding="unicode"), json.dumps(JSON))
    if robot is not None:
        assert_valid_robot(robot)

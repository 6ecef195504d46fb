"""Faulty robot descriptions: each is refused with a message of one line that names the part and the fault."""

import re
import shutil

import pytest

from jumper_warp.robot.description import DEFAULT_DESCRIPTION, RobotDescriptionError, load_description

URDF = "jumper.urdf"
JSON = "jumper.json"


@pytest.fixture
def assets(tmp_path):
    """Writable copy of the robot's folder."""
    return shutil.copytree(DEFAULT_DESCRIPTION.parent, tmp_path / "jumper")


def edit(folder, file, pattern, replacement):
    """Replace all matches of a regular expression in a file of the folder, at least one."""
    text, matches = re.subn(pattern, replacement, (folder / file).read_text(), flags=re.DOTALL)
    assert matches, f"{pattern} does not occur in {file}"
    (folder / file).write_text(text)


def refusal(folder):
    """Return the message, of one line, with which the description in a folder is refused."""
    with pytest.raises(RobotDescriptionError) as caught:
        load_description(folder / JSON)
    message = str(caught.value)
    assert "\n" not in message
    return message


def at(element, inner, new):
    """Return pattern and replacement for `edit`: `inner`, in the URDF element given as "tag name", becomes `new`."""
    tag, name = element.split()
    return rf'(<{tag} name="{name}"(?:(?!</{tag}>).)*?){inner}', rf"\g<1>{new}"


NUMBERS = '"[^"]*"'  # pattern of an attribute's value

BAD_URDF = {  # by fault: (pattern, replacement) for `edit`, and part of the message
    "negative mass": (at("link FR_housing", f"value={NUMBERS}", 'value="-1"'), "link FR_housing: expected mass > 0"),
    "nan mass": (at("link body", f"value={NUMBERS}", 'value="nan"'), "link body: expected 1 finite"),
    "infinite inertia": (at("link body", f"ixx={NUMBERS}", 'ixx="inf"'), "link body: expected 1 finite"),
    "zero moment": (at("link BL_housing", f"izz={NUMBERS}", 'izz="0"'), "link BL_housing: expected a positive inertia"),
    "triangle": (at("link body", f"izz={NUMBERS}", 'izz="0.3"'), "link body: expected principal moments"),
    "zero axis": (at("joint FL_outer", "0 -1 0", "0 0 0"), "joint FL_outer: expected an axis of length 1"),
    "long axis": (at("joint FL_outer", "0 -1 0", "0 -2 0"), "joint FL_outer: expected an axis of length 1"),
    "wrong axis": (at("joint FL_outer", "0 -1 0", "0 1 0"), "joint FL_outer: expected axis"),
    "inverted limits": (at("joint BR_inner", f"lower={NUMBERS}", 'lower="3"'),
        "joint BR_inner: expected lower < upper"),
    "turned frame": (at("joint BR_inner", "<origin", '<origin rpy="0 0 1"'),
        "joint BR_inner: expected a frame parallel"),
    "unlike motor": (('effort="24.8"', 'effort="18"'), "joint FL_outer: expected effort 24.8 of motor AK70-10"),
    "heavy leg": (at("link BR_outer_thigh", '"0.081"', '"0.09"'),
        "link BR_outer_thigh: expected mass, com, inertia to"),
    "unmirrored com": (at("link FR_housing", "0928 -", "0928 "), "link FR_housing: expected mass, com, inertia to"),
    "moved hip": (at("joint FR_lateral", "-0.105", "-0.1"), "joint FR_lateral: expected to mirror FL_lateral"),
    "no paw": (at("link BL_inner_shank", "<collision>.*?</collision>", ""),
        "link BL_inner_shank: expected 1 collision"),
    "missing mesh": (("meshes/thigh.obj", "meshes/none.obj"), "missing file 'meshes/none.obj'"),
    "mesh outside": (("meshes/thigh.obj", "../../../etc/thigh.obj"), "expected a file inside"),
    "remote mesh": (("meshes/thigh.obj", "https://example.org/thigh.obj"), "expected a file inside"),
    "file uri": (("meshes/thigh.obj", "file:///tmp/thigh.obj"), "expected a file inside"),
    "second link": (("</robot>", '<link name="body"/></robot>'), "link body: expected one, found 2"),
    "second joint": (('joint name="FR_outer"', 'joint name="FL_outer"'), "joint FL_outer: expected one, found 2"),
    "second parent": (('child link="BR_inner_shank"', 'child link="BR_outer_shank"'), "expected one parent joint"),
    "renamed root": (('name="body"', 'name="trunk"'), "joint FL_lateral: unknown link 'body'"),
    "cycle": (at("joint FL_lateral", '"body"', '"FL_inner_shank"'), "joint FL_lateral: expected parent body and child"),
    "second root": ((r'  <joint name="FL_lateral".*?</joint>\n', ""),
        "expected the one root link body, found body, FL_h"),
    "heavy body": (at("link body", '"6.43"', '"6.43e3"'),
        "link body: mass must be between 0.001 and 100 kg, got 6430"),
    "compact body": (
        at("link body", 'ixx="0.0536" iyy="0.1495" izz="0.1952"', 'ixx="5.36e-5" iyy="1.495e-4" izz="1.952e-4"'),
        "link body: largest radius of gyration must be between 0.1 and 1.5 of the link's reach, got 0.0144"),
    "wide body": (at("link body", '"6.43"', '"0.00643"'),
        "link body: smallest radius of gyration must be between 0.001 and 2 m, got 2.887"),
    "thin link": (
        at("link FL_outer_thigh", 'ixx="0.000518" iyy="0.000524" izz="7.9e-06"', 'ixx="5e-4" iyy="5e-4" izz="7.9e-9"'),
        "link FL_outer_thigh: smallest radius of gyration must be between 0.001 and 2 m, got 0.000312"),
    "far com": (at("link body", "0.0111", "11.1"),
        "link body: z of centre of mass must be between -2 and 2 m, got 11.1"),
    "huge paw": (('radius="0.025"', 'radius="1e30"'),
        "link FL_inner_shank: sphere size must be between 0.0001 and 2 m"),
    "large paw": (('radius="0.025"', 'radius="0.25"'),
        "link FL_inner_shank: paw radius must be between 0.001 and 0.2 m"),
    "far hip": (at("joint FR_lateral", "-0.105", "-105"),
        "joint FR_lateral: y of origin must be between -2 and 2 m"),
    "narrow hips": (('(xyz="-?0.1433) ', r"\g<1>e-6 "), "joint FL_lateral: hip x must be between 0.001 and 2 m"),
    "stop beyond a turn": (at("joint BR_inner", "2.443461", "140"),
        "joint BR_inner: upper must be between -6.283 and 6.283"),
    "effort": (at("joint FL_inner_knee", '"1000"', '"1e9"'),
        "joint FL_inner_knee: effort must be between 0.1 and 1e+04"),
    "shape turned in degrees": (("1.5707963267948966", "90"), "link body: expected rpy within a turn"),
    "color of 255": (("0.93 0.42 0.1 1", "237 107 25 1"), "link body: color must be between 0 and 1, got 237"),
    "entity": (("<robot", '<!DOCTYPE robot [<!ENTITY a "b">]><robot'), "expected no document type"),
    "truncated": (("</robot>.*", ""), "expected well-formed XML"),
    "other root": (("<robot(.*)</robot>", r"<sdf\1</sdf>"), "expected <robot>, found <sdf>"),
}  # fmt: skip

BAD_JSON = {  # as BAD_URDF
    "missing loop": ((r'"BR_ankle": \{.*?\}', '"extra": {}'), "loop extra: expected one of"),
    "doubled loop": (('"BR_ankle": ', '"BL_ankle": '), "not JSON ('BL_ankle' occurs twice)"),
    "unknown link": (('"child": "FL_outer_shank"', '"child": "FL_paw"'), "loop FL_ankle: unknown link 'FL_paw'"),
    "other link": (('"FL_outer_shank"', '"FR_outer_shank"'), "loop FL_ankle: expected link FL_outer_shank"),
    "open anchor": ((r'"child_anchor": \[0, 0, -0.3', '"child_anchor": [0, 0, -0.31'),
        "loop FL_ankle: expected both anc"),
    "unknown motor": (('"FR_outer": "AK70-10"', '"FR_outer": "AK60"'), "motor FR_outer: unknown motor type 'AK60'"),
    "missing motor": (('"FR_outer": "AK70-10", ', ""), "motors: expected FR_outer to be a str, found nothing"),
    "extra motor": (('"FR_outer": ', '"tail": "AK80-9", "FR_outer": '), "motor tail: expected one of"),
    "swapped motor": (('"FR_outer": "AK70-10"', '"FR_outer": "AK80-9"'), "motor FR_outer: expected AK70-10"),
    "negative rotor": (("5.79e-5", "-5.79e-5"), "motor type AK80-9: expected rotor_inertia > 0"),
    "zero gain": (('"kp": 17.0', '"kp": 0'), "motor type AK80-9 jumping: expected kp > 0"),
    "high cutoff": (('"cutoff_speed_rpm": 335', '"cutoff_speed_rpm": 500'), "AK80-9: expected cutoff_speed_rpm <"),
    "friction": (('"coulomb_friction": 0.02', '"coulomb_friction": 1e8'),
        "motor type AK80-9: coulomb_friction must be between 0 and 10 N m, got 1e+08"),
    "friction above torque": (('"peak_torque": 18.0(.*?)0.02', r'"peak_torque": 1.8\g<1>2.0'),
        "AK80-9: coulomb_friction must be between 0 and 1.8 N m (peak_torque), got 2"),
    "rotor in g cm^2": (("5.79e-5", "579"), "motor type AK80-9: rotor_inertia must be between 1e-08 and 0.01 kg m^2"),
    "speed in rpm": (('"no_load_speed_rpm": 470', '"no_load_speed_rpm": 47000'),
        "no-load speed must be between 0.1 and 1000"),
    "gain": (('"kp": 17.0, "kd": 1.8', '"kp": 17.0, "kd": 1800'),
        "AK80-9: jumping kd must be between 0.01 and 100 N m s/rad"),
    "knee damping": (('"knee_damping": 0.1', '"knee_damping": 1e5'),
        "knee_damping must be between 1e-06 and 10 N m s/rad"),
    "sum in tenths": ((r"\[0, 240\]", "[0, 2400]"), "upper transversal_sum must be between -12.57 and 12.57 rad"),
    "long shank": ((r'"child_anchor": \[0, 0, -0.3', '"child_anchor": [0, 0, -300'),
        "loop FL_ankle: z of anchor on FL_outer_shank"),
    "infinite number": (('"knee_damping": 0.1', '"knee_damping": 1e999'), "not JSON (1e999 is not a finite number)"),
    "nan": (('"knee_damping": 0.1', '"knee_damping": NaN'), "not JSON (NaN is not a finite number)"),
    "huge integer": (('"knee_damping": 0.1', '"knee_damping": ' + "9" * 5000), "not JSON (an integer of 5000 digits)"),
    "no default pose": (('"default": ', '"other": '), "poses: expected a pose named default"),
    "pose beyond stops": (('"transversal_deg": 45', '"transversal_deg": 150'),
        "pose default: expected FL_outer within"),
    "pose beyond sum": (('"transversal_deg": 45', '"transversal_deg": 125'),
        "pose default: expected the transversal sum"),
    "inverted sum": ((r"\[0, 240\]", "[240, 0]"), "transversal_sum_deg: expected lower < upper"),
    "urdf outside": (('"jumper.urdf"', '"../jumper.urdf"'), "urdf: expected a file inside"),
    "urdf missing": (('"jumper.urdf"', '"other.urdf"'), "urdf: missing file"),
    "urdf nul": (('"jumper.urdf"', r'"a\\u0000b"'), "is not a file name"),
    "list": (("^.*$", "[]"), "expected a JSON object"),
    "deep": (("^.*$", "[" * 100000), "not JSON (more than 50 levels)"),
    "malformed": ((r"\}\s*$", ""), "not JSON (line"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_URDF)
def test_refuses_faulty_urdf(assets, case):
    change, message = BAD_URDF[case]
    edit(assets, URDF, *change)
    assert message in refusal(assets)


@pytest.mark.parametrize("case", BAD_JSON)
def test_refuses_faulty_json(assets, case):
    change, message = BAD_JSON[case]
    edit(assets, JSON, *change)
    assert message in refusal(assets)


def test_refuses_a_loop_that_cannot_close(assets):
    # at 45 degrees the knees are 0.09 + 0.35 sin(45) = 0.3375 m apart, out of reach of two shanks of 0.15 m
    edit(assets, JSON, r"-0\.3\]", "-0.15]")
    edit(assets, URDF, r"(<collision><origin xyz=\"0 0 )-0\.3", r"\g<1>-0.15")
    assert "pose default: the loop FL_ankle cannot close" in refusal(assets)


def test_refuses_a_missing_file_and_a_folder(tmp_path):
    for path, message in ((tmp_path / "none.json", "no such file"), (tmp_path, "a folder, not a file")):
        with pytest.raises(RobotDescriptionError, match=message):
            load_description(path)


def test_refuses_a_mesh_in_millimetres(assets):
    edit(assets, "meshes/shell.obj", r"v (\S+) ", r"v \g<1>e3 ")  # x in mm
    assert "link body: smallest mesh coordinate must be between -2 and 2 m, got -3" in refusal(assets)


def test_refuses_a_mesh_with_an_index_beyond_its_vertices(assets):
    (assets / "meshes" / "thigh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n")
    assert "thigh.obj: expected triangles between the 3 vertices" in refusal(assets)

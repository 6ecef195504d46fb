"""Faulty robot descriptions: each is refused with a message of one line that names the part and the fault."""

import re
import shutil

import pytest

from jumper_warp.robot.description import DEFAULT_DESCRIPTION, RobotDescriptionError, load_description


@pytest.fixture
def assets(tmp_path):
    """Writable copy of the robot's folder."""
    return shutil.copytree(DEFAULT_DESCRIPTION.parent, tmp_path / "jumper")


def at(element, inner, new):
    """Return pattern and replacement for `edit`: `inner`, in the URDF element given as "tag name", becomes `new`."""
    tag, name = element.split()
    return rf'(<{tag} name="{name}"(?:(?!</{tag}>).)*?){inner}', rf"\g<1>{new}"


NUMBERS = '"[^"]*"'  # pattern of an attribute's value

FAULTS = {  # by fault: (pattern, replacement) for `edit` of the file that has the pattern, and part of the message
    "negative mass": (at("link FR_housing", f"value={NUMBERS}", 'value="-1"'), "link FR_housing: expected mass > 0"),
    "triangle": (at("link body", f"izz={NUMBERS}", 'izz="0.3"'), "link body: expected principal moments"),
    "wrong axis": (at("joint FL_outer", "0 -1 0", "0 1 0"), "joint FL_outer: expected axis"),
    "unlike motor": (('effort="24.8"', 'effort="18"'), "joint FL_outer: expected effort 24.8 of motor AK70-10"),
    "heavy leg": (at("link BR_outer_thigh", '"0.081"', '"0.09"'),
        "link BR_outer_thigh: expected mass, com, inertia to"),
    "moved hip": (at("joint FR_lateral", "-0.105", "-0.1"), "joint FR_lateral: expected to mirror FL_lateral"),
    "second link": (("</robot>", '<link name="body"/></robot>'), "link body: expected one, found 2"),
    "wide body": (at("link body", '"6.43"', '"0.00643"'),
        "link body: smallest radius of gyration must be between 0.001 and 2 m, got 2.887"),
    "shape turned in degrees": (("1.5707963267948966", "90"), "link body: expected rpy within a turn"),
    "truncated": (("</robot>.*", ""), "expected well-formed XML"),
    "missing loop": ((r'"BR_ankle": \{.*?\}', '"extra": {}'), "loop extra: expected one of"),
    "open anchor": ((r'"child_anchor": \[0, 0, -0.3', '"child_anchor": [0, 0, -0.31'),
        "loop FL_ankle: expected both anc"),
    "swapped motor": (('"FR_outer": "AK70-10"', '"FR_outer": "AK80-9"'), "motor FR_outer: expected AK70-10"),
    "rotor in g cm^2": (("5.79e-5", "579"), "motor type AK80-9: rotor_inertia must be between 1e-08 and 0.01 kg m^2"),
    "sum in tenths": ((r"\[0, 240\]", "[0, 2400]"), "upper transversal_sum must be between -12.57 and 12.57 rad"),
    "nan": (('"knee_damping": 0.1', '"knee_damping": NaN'), "not JSON (NaN is not a finite number)"),
    "pose beyond sum": (('"transversal_deg": 45', '"transversal_deg": 125'),
        "pose default: expected the transversal sum"),
}  # fmt: skip


@pytest.mark.parametrize("case", FAULTS)
def test_refuses_a_faulty_description_in_one_line(assets, case):
    (pattern, replacement), message = FAULTS[case]
    found = False
    for file in ("jumper.urdf", "jumper.json"):
        text, matches = re.subn(pattern, replacement, (assets / file).read_text(), flags=re.DOTALL)
        (assets / file).write_text(text)
        found |= matches > 0
    assert found, f"{pattern} does not occur"
    with pytest.raises(RobotDescriptionError) as caught:
        load_description(assets / "jumper.json")
    assert message in str(caught.value) and "\n" not in str(caught.value)

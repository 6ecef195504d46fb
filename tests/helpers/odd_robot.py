"""Table of a robot unlike the Jumper: unequal shanks, paws beyond the ankles, other back legs, an asymmetric leg."""

from jumper_warp.robot.description import load_description
from jumper_warp.robot.folder import table_of


def set_value(section, name, value):
    """Replace the value of a quantity in a section of a robot's table."""
    section[name] = {**section[name], "value": value}


def odd_table():
    """Return the table of the robot."""
    table = table_of(load_description(), "test")
    table["name"] = "odd"
    for name, value in {"thigh": 0.18, "outer_shank": 0.31, "inner_shank": 0.28, "paw_offset": 0.04}.items():
        set_value(table["front"], name, value)
    for name, value in {"thigh": 0.16, "outer_shank": 0.27, "inner_shank": 0.29, "transversal_motor": "weak"}.items():
        set_value(table["back"], name, value)
    table["motors"]["weak"] = {name: dict(row) for name, row in table["motors"]["AK70-10"].items()}
    for name, value in {"peak_torque": 12.4, "rotor_inertia": 3.0e-5, "kp_jumping": 12.0, "kp_walking": 12.0}.items():
        set_value(table["motors"]["weak"], name, value)
    table["BR"] = {"outer_shank": {"value": 0.265, "unit": "m", "source": "test"}}
    return table

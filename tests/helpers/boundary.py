"""Readers of the package's input files, and mutations of these files, for the tests in `tests/boundary`."""

import contextlib
import copy
import hashlib
import io
import itertools
import json
import math
import os
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import torch

from box_robot import box_recording, walk
from jumper_warp.cli.info import policy_info
from jumper_warp.cli.main import dispatch
from jumper_warp.deploy.policy import JOINTS, DeployedPolicy
from jumper_warp.evaluation.scripts import read_script
from jumper_warp.identification.motions import RecordedMotion, load_motion
from jumper_warp.policies.catalog import summarise
from jumper_warp.policies.folder import add_files, save_policy
from jumper_warp.policies.onnx import onnx_model
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.runs import load_policy
from jumper_warp.policies.spec import PolicyInterface, checksum_entry
from jumper_warp.registry import TASKS, make_task
from jumper_warp.rl.checkpoint import best_checkpoint, load_checkpoint, save_checkpoint
from jumper_warp.robot.description import DEFAULT_DESCRIPTION, load_description
from jumper_warp.robot.motors import vertical_jump_filter
from jumper_warp.robot.overlay import RobotOverlay, load_overlay
from jumper_warp.tasks.saving import task_from_json, task_to_json
from jumper_warp.utils.dumps import NonFiniteValue, load_dump, write_dump
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import read_json
from jumper_warp.viz.recording import load_npz
from jumper_warp.viz.rerun import write_rrd

TETRAHEDRON = "v 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nv 0 0 -0.1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
TASK_FILE = """\
from dataclasses import replace
from jumper_warp.registry import make_task, register_task

def boundary_jump():
    return replace(make_task("vertical-jump"), name="boundary-jump")

register_task("boundary-jump", boundary_jump)
"""
READINGS = {"angle": np.linspace(-0.2, 1.0, 12), "rate": np.linspace(-3.0, 3.0, 12)}


@dataclass(frozen=True)
class Reader:
    """A reader of the package with the files that it reads."""

    files: dict[str, bytes]  # Valid content by file name
    read: Callable[[Path], Any]  # Reads the files in a folder; returns what its caller uses, as comparable data
    sign: Callable[[dict[str, bytes]], None] = lambda files: None  # Updates checksums in the content of files
    json_file: str = ""  # JSON file whose entries are mutated one at a time
    named: tuple[str, ...] = ()  # Further texts that a message may have in place of a file's name

    def outcome(self, folder: Path) -> str:
        """Return "refused", "same" or "changed": behaviour with the files in a folder against the valid files.

        Raises AssertionError unless a refusal is one line with a file's name.
        """
        try:
            got = self.read(folder)
        except InputError as error:
            text = str(error)
            assert len(text.splitlines()) == 1 and len(text) < 1000, text
            assert folder.name in text or any(name in text for name in (*self.files, *self.named)), text
            return "refused"
        return "same" if got == self.expected(folder.parent) else "changed"

    def expected(self, parent: Path) -> Any:
        """Return what `read` returns for the valid files; computed once."""
        if id(self) not in _EXPECTED:
            folder = parent / "valid"
            self.write(folder, self.files)
            _EXPECTED[id(self)] = self.read(folder)
        return _EXPECTED[id(self)]

    def write(self, folder: Path, files: dict[str, bytes]) -> Path:
        """Replace the content of a folder by files."""
        shutil.rmtree(folder, ignore_errors=True)
        for name, data in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
        return folder


_EXPECTED: dict[int, Any] = {}


# ---------------------------------------------------------------------- readers


def small_policy(num_obs=24):
    """Return a policy for 12 motors that observes angles and rates, with random weights."""
    torch.manual_seed(2)
    term = {"scale": 1.0, "clip": 100.0, "history": 1}
    interface = PolicyInterface.from_json({
        "task": "vertical-jump", "observation_names": [f"obs_{i}" for i in range(num_obs)], "joint_names": list(JOINTS),
        "action_scale": [0.3] * 12, "default_joint_pos": [0.1] * 12, "joint_stiffness": [17.0] * 12,
        "joint_damping": [1.8] * 12, "torque_limit": [18.0] * 12, "policy_dt": 1.0 / 60.0, "physics_dt": 1.0 / 480.0,
        "command_filter": json.loads(json.dumps(vars(vertical_jump_filter()), default=vars)), "hidden": [6, 4],
        "activation": "elu", "observation_limit": 100.0, "normalised_limit": 10.0, "quaternion_order": "xyzw",
        "observation_layout": {"angle": term | {"first": 0, "end": 12}, "rate": term | {"first": 12, "end": 24}},
    })  # fmt: skip
    layers = [(torch.randn(o, i), torch.randn(o)) for i, o in itertools.pairwise((num_obs, 6, 4, 12))]
    return Policy(layers, torch.randn(num_obs), torch.rand(num_obs) + 0.1, interface, {"env": {"seed": 5}})


def files_in(folder):
    """Return the content of all files in a folder by relative name."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def policy_reader(folder):
    """Return the reader of a policy folder."""
    save_policy(folder, small_policy())
    add_files(folder, {"picture.webp": b"RIFF", "metrics.json": b"{}"})

    def read(where):
        policy = load_policy(where)
        return policy.act(torch.linspace(-3.0, 3.0, 48).reshape(2, 24)).tolist(), policy.interface

    def sign(files):
        """Update the checksums of all files in the manifest."""
        manifest = json.loads(files["manifest.json"])
        sums = {name: hashlib.sha256(files[name]).hexdigest() for name in manifest["sha256"] if name in files}
        files["manifest.json"] = json.dumps(manifest | {"sha256": manifest["sha256"] | sums}).encode()

    return Reader(files_in(folder), read, sign, "config.json")


def manifest_reader(folder):
    """Return the reader of a policy folder for mutations of its manifest."""
    return replace(policy_reader(folder), json_file="manifest.json", sign=lambda files: None)


def metrics():
    """Return valid metrics of an evaluation, as JSON data."""
    rate = {"value": 0.9, "unit": None, "trials": 10, "interval": [0.6, 0.98], "over": "jumps"}
    error = {"value": 0.01, "unit": "m", "trials": 10, "interval": None, "over": "jumps"}
    values = {"success_rate": rate, "apex_error_abs_mean_m": error, "fall_rate": rate}
    return {"schema": "jumper-warp metrics", "version": 1, "conditions": {"commands": "0.5 m"}, "metrics": values}


def info_reader(folder):
    """Return `jumper info` of a policy folder as a reader; its page has no checksum and is left out."""
    save_policy(folder, small_policy())
    add_files(folder, {"metrics.json": json.dumps(metrics()).encode()})
    (folder / "README.md").unlink()

    def read(where):
        content, lines = policy_info(summarise(where))
        return "\n".join([str(content), *lines]).replace(str(where), "FOLDER").replace(where.name, "FOLDER")

    return Reader(files_in(folder), read, json_file="manifest.json")


def metrics_reader(folder):
    """Return `jumper info` as a reader of metrics that the manifest matches; which values it prints does not count."""
    policy = policy_reader(folder)
    add_files(folder, {"metrics.json": json.dumps(metrics()).encode()})
    files = {name: data for name, data in files_in(folder).items() if name != "README.md"}

    def read(where):
        policy_info(summarise(where))

    return Reader(files, read, policy.sign, "metrics.json")


def packed(file, arrays):
    """Return a function that packs `header.json` among files and `arrays` into an npz `file`."""

    def pack(files):
        data = io.BytesIO()
        np.savez_compressed(data, header=np.array(files.pop("header.json").decode()), **arrays)
        files[file] = data.getvalue()

    return pack


def archive_reader(folder, file, read):
    """Return the reader of an npz in a folder whose header is JSON; `header.json` stands for the header."""
    with np.load(folder / file) as archive:
        arrays = {name: archive[name] for name in archive.files}
    header = {"header.json": str(arrays.pop("header")).encode()}
    files = header | {file: (folder / file).read_bytes()}
    return Reader(files, lambda where: read(where / file), packed(file, arrays), "header.json", ("header",))


def recording_reader(folder):
    """Return the reader of a recording; which valid names it has does not count."""
    positions = walk(0.1, 0.1)
    fields = {"labels": ("a walk",), "states": {"phase": len(positions) * ["walks"]}, "notes": {"task": "walk"}}
    series = {"base/height [m]": np.zeros(len(positions))}
    folder.mkdir()
    box_recording(positions, series=series, goals=np.zeros((1, 1, 3)), **fields).save_npz(folder / "walk.npz")

    def read(path):
        recording = load_npz(path)
        write_rrd(recording, path.with_name("walk.rrd"))  # uses all entries
        return recording.poses.tolist()

    return archive_reader(folder, "walk.npz", read)


def dump_reader(folder):
    """Return the reader of a dump of a training; which valid names and counts it has does not count."""
    shapes = {"joint_q": 43, "joint_qd": 38, "action": 12, "rewards": 1, "observations": 2}
    arrays = {name: np.linspace(0.0, 1.0, size) for name, size in shapes.items()}
    names = {"rewards": ["tilt"], "observations": ["actor.x", "actor.y"]}
    found = NonFiniteValue("rewards.tilt", math.nan, 3, 17, arrays, names)
    write_dump(folder / "tilt.npz", found, iteration=3, task="jump", config={"train": {"seed": 11}})

    def read(path):
        loaded, header = load_dump(path)
        assert all(len(loaded.names[name]) == len(loaded.arrays[name]) for name in names), header
        return {name: values.tolist() for name, values in loaded.arrays.items()}

    return archive_reader(folder, "tilt.npz", read)


def deploy_reader(folder):
    """Return the reader of an exported ONNX file; `metadata.json` stands for the interface in its metadata."""
    model = onnx_model(small_policy(), {"commit": None, "dirty": None})
    metadata = {entry.key: entry.value for entry in model.metadata_props}

    def sign(files):
        """Write the metadata into the ONNX file, with its checksum."""
        del model.metadata_props[:]
        model.metadata_props.add(key="jumper_warp", value=files.pop("metadata.json").decode())
        data = model.SerializeToString(deterministic=True)
        files["policy.onnx"] = data + checksum_entry(data)

    files = {"metadata.json": metadata["jumper_warp"].encode()}
    signed = dict(files)
    sign(signed)
    (content,) = signed.values()

    def read(where):
        policy = DeployedPolicy(where / "policy.onnx")
        return [policy.targets(READINGS).tolist() for _ in range(2)]

    return Reader({"policy.onnx": content} | files, read, sign, "metadata.json")


def overlay_reader(folder):
    """Return the reader of a robot overlay."""
    values = {"base_mass": (7.0,), "link_mass": (1.1, 1.0, 1.0, 1.0, 0.9), "kp": (1.2,) + 11 * (0.9,),
              "no_load_speed": 12 * (44.0,), "latency": (0.004,), "armature": 12 * (0.005,)}  # fmt: skip
    overlay = RobotOverlay(values, {"base_mass": (-0.1, 0.1), "latency": (3.0, 5.0)}, "a bench")

    def read(where):
        loaded = load_overlay(where / "robot.json")
        robots = {name: array.tolist() for name, array in vars(loaded.robots()).items()}
        return robots, loaded.randomization, loaded.latency

    return Reader({"robot.json": json.dumps(overlay.to_json()).encode()}, read, json_file="robot.json")


def description_reader(folder):
    """Return the reader of a robot description, with a tetrahedron for each mesh."""
    files = files_in(DEFAULT_DESCRIPTION.parent)
    root = ElementTree.fromstring(files["jumper.urdf"])
    for link in root.findall("link"):
        for visual in link.findall("visual")[link.get("name") == "body" :]:
            link.remove(visual)  # faster to read
    files = {"jumper.json": files["jumper.json"], "jumper.urdf": ElementTree.tostring(root)}
    files[f"meshes/{Path(root.find('.//mesh').get('filename')).name}"] = TETRAHEDRON.encode()

    def read(where):
        robot = load_description(where / "jumper.json")
        parts = (robot.links, robot.joints, robot.loops, robot.motors)
        numbers = (robot.knee_damping, robot.knee_damping_limit, robot.transversal_sum, dict(robot.poses))
        return plain(parts), numbers

    return Reader(files, read, json_file="jumper.json")


def plain(part):
    """Return nested data classes, tuples and arrays as nested lists, without paths."""
    if isinstance(part, np.ndarray):
        return part.tolist()
    if isinstance(part, tuple | list):
        return [plain(member) for member in part]
    return (
        plain([value for value in vars(part).values()])
        if hasattr(part, "__dataclass_fields__")
        else (None if isinstance(part, Path) else part)
    )


def script_reader(folder):
    """Return the reader of a script of commands."""
    script = [{"walk": [0.5, 0, 0.3], "seconds": 4.0}, {"stand": 1.5}, {"jump_up": 0.75}, {"jump_to": [0.85, -0.1]}]
    return Reader({"script.json": json.dumps(script).encode()}, lambda where: read_script(where / "script.json"),
                  json_file="script.json")  # fmt: skip


def motion():
    """Return a short motion of random values."""
    rng = np.random.default_rng(0)
    return RecordedMotion("walk", np.arange(6) / 240.0, rng.normal(size=(6, 12)), angle=rng.normal(size=(6, 12)))


def motion_data(path):
    """Return what identification uses of a motion file."""
    loaded = load_motion(path)
    columns = {name: array.tolist() for name, array in loaded.columns().items()}
    return columns, loaded.base, loaded.gains, loaded.torque_limit


def npz_reader(folder):
    """Return the reader of a motion as npz; `settings.json` stands for its settings."""

    def pack(files):
        """Write the settings into the npz file."""
        data = io.BytesIO()
        np.savez_compressed(data, settings=np.array(files.pop("settings.json").decode()), **motion().columns())
        files["walk.npz"] = data.getvalue()

    settings = {"settings.json": json.dumps({"base": "fixed", "gains": "jumping", "torque_limit": 12.0}).encode()}
    packed = dict(settings)
    pack(packed)
    return Reader(packed | settings, lambda where: motion_data(where / "walk.npz"), pack, "settings.json")


def csv_reader(folder):
    """Return the reader of a motion as CSV with its settings."""
    columns = {"time": motion().time}
    columns |= {f"{name}/{joint}": getattr(motion(), name)[:, i] for name in ("target", "angle")
                for i, joint in enumerate(JOINTS)}  # fmt: skip
    rows = [",".join(columns), *(",".join(map(str, row)) for row in zip(*columns.values(), strict=True))]
    files = {"walk.csv": "\n".join([*rows, ""]).encode(), "walk.json": b'{"base": "fixed", "torque_limit": 12.0}'}
    return Reader(files, lambda where: motion_data(where / "walk.csv"), json_file="walk.json")


def parquet_reader(folder):
    """Return the reader of a motion as Parquet."""
    import pyarrow
    import pyarrow.parquet

    columns = {f"{name}/{joint}": getattr(motion(), name)[:, i] for name in ("target", "angle")
               for i, joint in enumerate(JOINTS)}  # fmt: skip
    data = io.BytesIO()
    pyarrow.parquet.write_table(pyarrow.table({"time": motion().time, **columns}), data)
    return Reader({"walk.parquet": data.getvalue()}, lambda where: motion_data(where / "walk.parquet"))


def module_reader(folder):
    """Return the reader of a user's file of tasks."""

    def read(where):
        before, printed = dict(TASKS), io.StringIO()
        try:
            with contextlib.redirect_stdout(printed):
                dispatch(["info", "boundary-jump", "--task-module", str(where / "boundary_tasks.py")])
            return printed.getvalue().replace(str(where), "FOLDER")
        finally:
            sys.modules.pop("boundary_tasks", None)
            TASKS.clear()
            TASKS.update(before)

    return Reader({"boundary_tasks.py": TASK_FILE.encode()}, read, named=("no policy 'boundary-jump'",))


def task_reader(folder):
    """Return the reader of a saved task."""
    files = {"task.json": json.dumps(task_to_json(make_task("vertical-jump"))).encode()}

    def read(where):
        return task_from_json(read_json(where / "task.json", "task"))

    return Reader(files, read, json_file="task.json", named=("task",))


def checkpoint_reader(folder):
    """Return the reader of a training checkpoint, with its manifest."""
    state = {"iteration": 7, "ppo": {"weight": torch.linspace(0.0, 1.0, 9)}, "env": {}, "rng": {}, "config": "{}"}
    save_checkpoint(folder, state, 0.5)

    def read(where):
        loaded = load_checkpoint(where / "iteration_000007.pt")
        return loaded.pop("ppo")["weight"].tolist(), loaded, best_checkpoint(where).name

    return Reader(files_in(folder), read, json_file="manifest.json")


READERS = {
    "policy": policy_reader, "manifest": manifest_reader, "info": info_reader, "metrics": metrics_reader,
    "recording": recording_reader, "dump": dump_reader, "deploy": deploy_reader, "overlay": overlay_reader,
    "description": description_reader, "script": script_reader, "npz": npz_reader, "csv": csv_reader,
    "parquet": parquet_reader, "module": module_reader, "task": task_reader, "checkpoint": checkpoint_reader,
}  # fmt: skip
"""Functions of an empty folder that return a reader, by name."""

# ---------------------------------------------------------------------- mutations


def nested(levels):
    """Return 1.0 in lists, `levels` deep."""
    return json.loads("[" * levels + "1.0" + "]" * levels)


JUNK = {
    "null": None, "true": True, "empty text": "", "text": "x", "path": "../x", "surrogate": "\ud800",
    "list": [], "object": {}, "list of null": [None], "object of text": {"x": "y"}, "nested": nested(60),
    "1e300": 1e300, "-1e300": -1e300, "huge": 10**400, "nan": math.nan, "infinite": -math.inf,
}  # fmt: skip
"""Values that no entry of any file may have, by name; an entry that may is in the list of harmless entries."""


def paths(tree, start=()):
    """Yield the path, a tuple of keys, of every entry of a JSON tree; of a list the first and the last entry."""
    keys = list(tree) if isinstance(tree, dict) else sorted({0, len(tree) - 1}) if tree else []
    for key in keys:
        yield (*start, key)
        if isinstance(tree[key], dict | list):
            yield from paths(tree[key], (*start, key))


def at(tree, path):
    """Return the container of an entry of a JSON tree, and its key there."""
    for key in path[:-1]:
        tree = tree[key]
    return tree, path[-1]


def put(value):
    """Return a mutation that replaces an entry by a value."""

    def change(table, key):
        if isinstance(value, bool) and isinstance(table[key], bool):
            return False  # the other choice
        table[key] = copy.deepcopy(value)

    return change


def scaled(factor):
    """Return a mutation that multiplies a number; it skips other entries and zero."""

    def change(table, key):
        if isinstance(table[key], bool) or not isinstance(table[key], int | float) or not table[key]:
            return False
        table[key] = table[key] * factor

    return change


def removed(table, key):
    """Remove an entry."""
    del table[key]


def doubled(table, key):
    """Insert an entry of a list twice; skips entries of objects."""
    if isinstance(table, dict):
        return False
    table.insert(key, copy.deepcopy(table[key]))


def renamed(table, key):
    """Rename an entry of an object; skips entries of lists."""
    if isinstance(table, list):
        return False
    table[f"{key} "] = table.pop(key)


def extended(table, key):
    """Add an unknown entry to an object; skips entries that are no objects."""
    if not isinstance(table[key], dict):
        return False
    table[key]["unknown"] = 1.0


ENTRY_MUTATIONS = {
    **{f"is {name}": put(value) for name, value in JUNK.items()},
    "times 1e12": scaled(1e12), "times -1e12": scaled(-1e12), "removed": removed, "doubled": doubled,
    "renamed": renamed, "has an unknown entry": extended,
}  # fmt: skip
"""Functions of a container and a key that change this entry in place, by name; they return False to skip it."""


def pipe(path):
    """Replace a file by a pipe without writer."""
    path.unlink()
    os.mkfifo(path)


def device(path):
    """Replace a file by a link to a device that never ends."""
    path.unlink()
    path.symlink_to("/dev/zero")


def loop(path):
    """Replace a file by a link to itself."""
    path.unlink()
    path.symlink_to(path.name)


def huge(path):
    """Extend a file to 10 GB, without using the disk."""
    os.truncate(path, 10 * 10**9)


def directory(path):
    """Replace a file by a folder."""
    path.unlink()
    path.mkdir()


FILE_KINDS = {"missing": Path.unlink, "folder": directory, "pipe": pipe, "device": device, "loop": loop, "10 GB": huge}
"""Functions that replace a file by something else, by name."""


def numeric_attributes(root):
    """Yield (attributes of the element, name) of each numeric attribute of an XML tree."""
    for element in root.iter():
        for name, text in element.attrib.items():
            if re.fullmatch(r"[-+\d.e\s]+", text):
                yield element.attrib, name


CONTENTS = {
    "empty": lambda data: b"", "first half": lambda data: data[: len(data) // 2], "without end": lambda data: data[:-2],
    "not UTF-8": lambda data: data[: len(data) // 2] + b"\xff\xfe" + data[len(data) // 2 :],
    "UTF-16": lambda data: data.decode("latin-1").encode("utf-16"), "zeros": lambda data: bytes(len(data)),
    "null byte": lambda data: data[: len(data) // 3] + b"\0" + data[len(data) // 3 :],
    "deep": lambda data: b"[" * 100_000, "400 digits": lambda data: b"9" * 400, "5000 digits": lambda data: b"9" * 5000,
    "noise": lambda data: np.random.default_rng(0).bytes(1000), "list": lambda data: b"[]",
    "null": lambda data: b"null",
}  # fmt: skip
"""Functions of a file's content that return another content, by name."""

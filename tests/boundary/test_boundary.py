"""Every reader refuses a mutated file in one line with its name, or behaves bitwise as with the valid file.

`HARMLESS` lists the entries that may change, each with its reason.
"""

import json
from xml.etree import ElementTree

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from boundary import CONTENTS, ENTRY_MUTATIONS, FILE_KINDS, READERS, at, numeric_attributes, paths

HARMLESS = {
    ("overlay", "values"): "an overlay may leave out quantities, which then come from the description",
    ("overlay", "randomization"): "an overlay may leave out ranges, which then are the task's",
    ("script", ""): "a script with one command less, or one twice, is a script",
    ("script", "seconds"): "a walk without a time lasts 2 s, as documented",
    ("npz", "base"): "without this setting the base is free, as documented",
    ("npz", "torque_limit"): "without this setting the limit is 18 N m, as documented",
    ("csv", "base"): "as of npz",
    ("csv", "torque_limit"): "as of npz",
    ("csv", "walk.json"): "a table needs no file of settings",
    ("checkpoint", "iteration_000007.pt.score"): "a score orders the checkpoints of a run; here is only one",
    ("description", "poses.nominal"): "only the default pose is needed",
    ("task", "reward_floor"): "null means that the reward has no floor",
    ("task", "levels"): "levels may repeat",
    ("task", "randomization"): "null means that a parameter is not randomised",
    ("task", "metrics"): "metrics may be null or repeat",
    ("task", "reset.settings.ground"): "the vertical jump stands on flat ground",
    ("task", "curriculum.unit"): "a label of the log",
    **{
        ("task", f"{part}name"): "names are free: they label logs and flags"
        for part in (
            "",
            "advance.",
            "curriculum.",
            "rewards.",
            "terminations.",
            "observations.actor.",
            "observations.critic.",
        )
    },
}
"""Reason by reader and file or dotted entry, without indices of lists; it holds for the entries inside, too."""
SYSTEMATIC = [
    "policy", "manifest", "info", "metrics", "recording", "dump", "deploy", "overlay", "script", "npz", "csv",
    "checkpoint",
]  # fmt: skip
SAMPLED = ["description", "task"]  # larger files, of which mutations are sampled
CHECKED = ["policy", "info", "deploy", "checkpoint", "npz", "recording", "dump"]  # with a checksum of each byte
LENIENT = ("removed", "doubled", "is object", "is list")  # missing settings of a task have defaults
COMMON = {"deadline": None, "derandomize": True, "suppress_health_check": list(HealthCheck)}


@pytest.fixture(scope="module")
def reader_of(tmp_path_factory):
    """Function that returns the reader of a name, which is made once, and a folder to read from."""
    readers = {}

    def get(name):
        if name not in readers:
            parent = tmp_path_factory.mktemp(name)
            readers[name] = READERS[name](parent / "made"), parent / "case"
        return readers[name]

    return get


def is_harmless(name, *keys):
    """Return whether `HARMLESS` lists an entry of a reader's file, or one that contains it; keys: its path."""
    words = [key for key in keys if isinstance(key, str)]
    return any((name, ".".join(words[:i])) in HARMLESS for i in range(len(words) + 1) if words[:i] or not words)


def outcome_of_entry(reader, folder, mutation, path):
    """Return the outcome of reading a file with one mutated entry; None: the mutation does not apply to it."""
    tree = json.loads(reader.files[reader.json_file])
    if ENTRY_MUTATIONS[mutation](*at(tree, path)) is False:
        return None
    files = {**reader.files, reader.json_file: json.dumps(tree).encode()}
    reader.sign(files)
    return reader.outcome(reader.write(folder, files))


@pytest.mark.parametrize("name", READERS)
def test_valid_files_are_read(reader_of, name):
    reader, folder = reader_of(name)
    assert reader.outcome(reader.write(folder, reader.files)) == "same"


@pytest.mark.parametrize("name", SYSTEMATIC)
@pytest.mark.parametrize("mutation", ENTRY_MUTATIONS)
def test_mutated_entry_is_refused_or_changes_nothing(reader_of, name, mutation):
    reader, folder = reader_of(name)
    entries = list(paths(json.loads(reader.files[reader.json_file])))
    outcomes = {path: outcome_of_entry(reader, folder, mutation, path) for path in entries}
    assert [path for path, got in outcomes.items() if got == "changed" and not is_harmless(name, *path)] == []


@pytest.mark.parametrize("name", SAMPLED)
@settings(max_examples=150, **COMMON)
@given(data=st.data())
def test_mutated_entry_of_a_large_file_is_refused_or_changes_nothing(reader_of, name, data):
    reader, folder = reader_of(name)
    path = data.draw(st.sampled_from(list(paths(json.loads(reader.files[reader.json_file])))))
    mutations = [mutation for mutation in ENTRY_MUTATIONS if name != "task" or mutation not in LENIENT]
    mutation = data.draw(st.sampled_from(mutations))
    assert outcome_of_entry(reader, folder, mutation, path) != "changed" or is_harmless(name, *path)


@settings(max_examples=150, **COMMON)
@given(data=st.data())
def test_mutated_urdf_is_refused_or_changes_nothing(reader_of, data):
    reader, folder = reader_of("description")
    root = ElementTree.fromstring(reader.files["jumper.urdf"])
    kind = data.draw(st.sampled_from(["number", "text", "removed", "doubled"]))
    if kind == "number":
        attributes, name = data.draw(st.sampled_from(list(numeric_attributes(root))))
        numbers = [float(word) for word in attributes[name].split()]
        at_number = data.draw(st.integers(0, len(numbers) - 1))
        change = data.draw(st.sampled_from(["nan", "inf", "x", "1e400", "1e9", "-1e9", ""]))
        words = [change if i == at_number else repr(number) for i, number in enumerate(numbers)]
        attributes[name] = " ".join(words)
    elif kind == "text":
        element = data.draw(st.sampled_from([element for element in root.iter() if element.attrib]))
        element.attrib[data.draw(st.sampled_from(sorted(element.attrib)))] = data.draw(
            st.sampled_from(["", "x", "../x"])
        )
    else:
        parent, index = data.draw(st.sampled_from([(p, i) for p in root.iter() for i in range(len(p))]))
        if kind == "removed":
            parent.remove(parent[index])
        else:
            parent.insert(index, parent[index])
    files = reader.files | {"jumper.urdf": ElementTree.tostring(root)}
    assert reader.outcome(reader.write(folder, files)) in ("refused", "same")


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("kind", FILE_KINDS)
def test_file_of_another_kind_is_refused(reader_of, name, kind):
    reader, folder = reader_of(name)
    for file in reader.files:
        FILE_KINDS[kind](reader.write(folder, reader.files) / file)
        assert reader.outcome(folder) != "changed" or is_harmless(name, file), file


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("content", CONTENTS)
def test_other_content_is_refused(reader_of, name, content):
    reader, folder = reader_of(name)
    for file, data in reader.files.items():
        reader.write(folder, reader.files | {file: CONTENTS[content](data)})
        assert reader.outcome(folder) != "changed", file


@pytest.mark.parametrize("name", CHECKED)
@settings(max_examples=40, **COMMON)
@given(data=st.data())
def test_damaged_bytes_are_refused_or_change_nothing(reader_of, name, data):
    reader, folder = reader_of(name)
    file = data.draw(st.sampled_from(sorted(reader.files)))
    damaged = bytearray(reader.files[file])
    place = data.draw(st.integers(0, len(damaged) - 1))
    kind = data.draw(st.sampled_from(["flip", "insert", "cut", "remove"]))
    if kind == "flip":
        damaged[place] ^= data.draw(st.integers(1, 255))
    elif kind == "insert":
        damaged[place:place] = data.draw(st.binary(min_size=1, max_size=4))
    else:
        del damaged[place : place + 4 if kind == "remove" else None]
    assert reader.outcome(reader.write(folder, reader.files | {file: bytes(damaged)})) != "changed"

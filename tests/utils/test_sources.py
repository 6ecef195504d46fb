"""Checksums of user files that a run depends on."""

import hashlib
import json.decoder
from pathlib import Path

from jumper_warp.registry import make_task
from jumper_warp.tasks.saving import task_to_json
from jumper_warp.utils.sources import changed_sources, source_checksums


def test_source_checksums_cover_only_modules_outside_the_project():
    functions = [{"func": "json.decoder:JSONDecoder"}, "jumper_warp.kernels.jump.rewards:base_at_rest"]
    saved = {"task": functions, "text": "no module: nothing", "number": 1}
    checksum = hashlib.sha256(Path(json.decoder.__file__).read_bytes()).hexdigest()
    assert source_checksums(saved) == {"json.decoder": checksum}
    assert source_checksums(["sys:path", "no.such.module:thing", None, 2.0]) == {}
    assert source_checksums(task_to_json(make_task("vertical-jump"))) == {}


def test_changed_sources_reports_only_known_modules():
    (line,) = changed_sources({"mine": "a", "other": "b"}, {"mine": "c", "other": "b", "new": "d"})
    assert line.startswith("mine has changed since the run was saved")
    assert changed_sources(None, {"mine": "c"}) == changed_sources({}, {}) == []

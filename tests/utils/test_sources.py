"""What a run remembers of a user's files."""

import hashlib
import json.decoder
from pathlib import Path

from jumper_warp.registry import make_task
from jumper_warp.tasks.saving import task_to_json
from jumper_warp.utils.sources import changed_sources, source_checksums


def test_files_outside_the_project_are_named_by_their_module():
    saved = {
        "task": [{"func": "json.decoder:JSONDecoder"}, "jumper_warp.kernels.jump.rewards:rest"],
        "say": "now: nothing",
        "n": 1,
    }
    held = hashlib.sha256(Path(json.decoder.__file__).read_bytes()).hexdigest()
    assert source_checksums(saved) == {"json.decoder": held}
    assert source_checksums(["sys:path", "no.such.module:thing", None, 2.0]) == {}
    assert source_checksums(task_to_json(make_task("vertical-jump"))) == {}


def test_changes_are_told_of_files_that_were_known():
    (line,) = changed_sources({"mine": "a", "other": "b"}, {"mine": "c", "other": "b", "new": "d"})
    assert line.startswith("mine has changed since")
    assert changed_sources(None, {"mine": "c"}) == changed_sources({}, {}) == []

import json

import numpy as np
import pytest

from jumper_warp.tasks.jump import references
from jumper_warp.tasks.jump.cfg import ReferenceCfg
from jumper_warp.tasks.jump.references import COLUMNS, ROWS, load_reference
from jumper_warp.utils.errors import InputError


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(references, "FOLDER", tmp_path)
    load_reference.cache_clear()
    yield tmp_path
    load_reference.cache_clear()


def content(**changed) -> str:
    rows = np.zeros((ROWS, len(COLUMNS))).tolist()
    return json.dumps({"columns": list(COLUMNS), "rows": rows, "distance_m": 1.0, "apex_m": 0.8} | changed)


def test_shipped_motions_push_off():
    for path in references.FOLDER.glob("*.json"):
        motion = load_reference(path.stem)
        x, z, _, forward, up, _ = motion.rows.T
        assert 0.1 < z[0] < 0.3 and z[-1] > z[0] and up[-1] > 1.0 and motion.apex > 0.6
        assert (np.diff(z) > -0.01).all() and abs(x).max() < 0.4 and abs(forward).max() < 4.0
    assert load_reference("farthest").distance > 1.5


@pytest.mark.parametrize(
    "text",
    [
        "{", "[]", content(rows=[[0.0] * 6]), content(columns=["x"]), content(apex_m=-1.0), content(distance_m="far"),
        content(rows=[[float("nan")] * 6] * ROWS), content(rows=[[1e9] * 6] * ROWS),
    ],
)  # fmt: skip
def test_files_that_are_no_motion_are_refused(folder, text):
    (folder / "bad.json").write_text(text)
    with pytest.raises(InputError, match="reference motion"):
        load_reference("bad")


@pytest.mark.parametrize("name", ["none", "../jumper", "", "A"])
def test_unknown_motions_are_refused(folder, name):
    (folder / "good.json").write_text(content())
    with pytest.raises(InputError, match="there are good"):
        load_reference(name)


@pytest.mark.parametrize(
    "settings", [{"share": 1.5}, {"reach": (0.0, 1.0)}, {"reach": (1.0, 0.5)}, {"share": float("nan")}]
)
def test_settings_that_cannot_be_are_refused(settings):
    with pytest.raises(InputError, match="reference share and reach"):
        ReferenceCfg(**settings)

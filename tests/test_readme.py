import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"


def test_examples_of_the_readme_run_and_the_robot_squats(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    examples = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert len(examples) == 4
    names = {}
    for example in examples:
        exec(example, names)
    height = names["recorder"].recording().series["base/height [m]"]
    assert len(height) == 60
    # Motors of 17 N m/rad commanded to 1 rad give way under the weight of 14.5 kg, 35.6 N per leg: with the ankle
    # 0.175 cos(t) + sqrt(0.3^2 - (0.045 + 0.175 sin(t))^2) below the hips, virtual work balances at t = 1.232 rad,
    # ankle 0.272 m and paw 0.297 m below. (A little less is borne by the motors: shanks and paws rest on the ground.)
    assert height[-1] == pytest.approx(0.297, abs=0.02)
    assert (tmp_path / "squat.rrd").stat().st_size > 0
    assert names["step"].reward.shape == (64,)
    assert names["gradient"].shape == (10, 12, 1) and abs(names["gradient"]).max() > 1.0e-4


def test_linked_files_exist():
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", README.read_text(encoding="utf-8"))
    assert links and all((README.parent / link).exists() for link in links), links

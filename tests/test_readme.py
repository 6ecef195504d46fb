import re
from pathlib import Path

README = Path(__file__).parents[1] / "README.md"


def test_examples_of_the_readme_run_and_the_robot_stands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    examples = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert len(examples) == 2
    names = {}
    for example in examples:
        exec(example, names)
    height = names["recorder"].recording().series["base/height [m]"]
    assert len(height) == 60
    # 0.8 rad at both motors: knees 0.175 cos 0.8 below the hips, 0.045 + 0.175 sin 0.8 beside the ankle's axis,
    # so the ankle is 0.122 + 0.247 m below the hips, and the paw reaches 0.025 m further; gravity bends that a little
    assert abs(height[-1] - 0.394) < 0.02
    assert (tmp_path / "stand.rrd").stat().st_size > 0


def test_linked_files_exist():
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", README.read_text(encoding="utf-8"))
    assert links and all((README.parent / link).exists() for link in links), links

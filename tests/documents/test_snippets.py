"""The mechanism that runs and checks the snippets of pages."""

import sys

import pytest

from jumper_warp.registry import TASKS
from snippets import Page, PageError

TASK = """```python
# my_task.py
from dataclasses import replace

from jumper_warp import make_task
from jumper_warp.registry import register_task


def my_jump():
    return replace(make_task("vertical-jump"), name="my-jump")


register_task("my-jump", my_jump)
```
"""


@pytest.fixture
def run(tmp_path):
    """Function that runs a page of the given text, whose first line is line 1, in the folder `tmp_path / "folder"`."""

    def run(text):  # Markdown
        (tmp_path / "folder").mkdir()
        (tmp_path / "page.md").write_text(text)
        Page(tmp_path / "page.md").run(tmp_path / "folder")

    return run


def bash(*lines, note=""):
    """Return a page with a bash fence whose first command is on line 2, on line 3 below a comment."""
    return "\n".join([*([note] if note else []), "```bash", *lines, "```", ""])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("jumper play vertical_jump --heigth 0.9", "Unrecognized options"),
        ("jumper play vertikal_jump", "no policy 'vertikal_jump'"),
        ("jumper train vertical-jump --robot heavy.json", "heavy.json: no such file"),
        ("jumper evaluate horizontal_jump --suite gird", "no suite 'gird'"),
        ("python experiments/vertical_sweep.py", "experiments/vertical_sweep.py: no such file"),
        ("python experiments/squat_hold.py --policy vertikal_jump", "no policy 'vertikal_jump'"),
        ("rerun outputs/jump.rrd", "outputs/jump.rrd: no such file"),
    ],
)
def test_wrong_command_fails_with_page_and_line(run, line, message):
    with pytest.raises(PageError, match=r"^page\.md:2: ") as error:
        run(bash(line))
    assert message in str(error.value)


def test_python_fences_share_names_and_report_page_and_line(run):
    with pytest.raises(PageError, match=r"^page\.md:6: ZeroDivisionError: division by zero$"):
        run("```python\nvalue = 0\n```\n\n```python\n1 / value\n```\n```python\nraise SystemError\n```\n")


def test_file_fences_are_written_and_tasks_forgotten_after_the_page(run, tmp_path):
    run(TASK + bash("jumper train my-jump --task-module my_task.py") + "```python\nimport my_task\n```\n")
    assert (tmp_path / "folder" / "my_task.py").read_text().startswith("# my_task.py\nfrom dataclasses")
    assert "my-jump" not in TASKS and "my_task" not in sys.modules


def test_marked_commands_run_in_the_folder_of_the_page_with_extra_flags_for_training(run, tmp_path):
    run(
        bash("jumper train vertical-jump --no-randomize", note="<!-- run: --max-iterations 1 --num-envs 4 -->")
        + bash("jumper export logs/vertical-jump/*", "mkdir new", note="<!-- run -->")
    )
    folder = tmp_path / "folder"
    assert (folder / "new").is_dir() and len(list(folder.glob("logs/vertical-jump/*/policy/policy.onnx"))) == 1

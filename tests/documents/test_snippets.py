"""The mechanism that runs and checks the snippets of pages."""

import sys

import pytest
from snippets import Page, PageError

from jumper_warp.registry import TASKS

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
    "lines",
    [
        ["jumper play vertical_jump --height 0.9 --out outputs/play", "rerun outputs/play/jump.rrd"],
        ["jumper train vertical-jump --num-envs 64 \\", "  --max-iterations 2  # a comment"],
        ["jumper train velocity-flat", "jumper evaluate logs/velocity-flat/RUN --no-randomize | head"],
        ["jumper train vertical-jump", "jumper train vertical-jump --resume latest", "jumper export FOLDER"],
        ["jumper finetune vertical_jump --out better", "jumper evaluate better --height-range 0.5 0.9"],
        ["jumper export vertical_jump --out jump.onnx", "jumper list && jumper info vertical_jump"],
        ["jumper evaluate horizontal_jump --suite grid", "jumper play --script assets/scripts/walk_jump_walk.json"],
        ["jumper sysid excite --out motions", "jumper sysid motions --mass 14.5 --out found",
         "jumper train vertical-jump --robot found/identified.json"],
        ["torchrun --nproc-per-node 2 -m jumper_warp train vertical-jump", "jumper --version"],
        ["python experiments/template.py --num-jumps 10", "make test", "python -m pytest tests/test_mdp.py",
         'pip install -e ".[gymnasium]"'],
    ],
)  # fmt: skip
def test_correct_commands_pass_and_do_not_run(run, tmp_path, lines):
    run(bash(*lines))
    assert sorted(path.name for path in (tmp_path / "folder").iterdir()) == ["assets", "experiments"]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("jumper play vertical_jump --heigth 0.9", "no flag --heigth"),
        ("jumper play vertical_jump --height tall", "--height takes"),
        ("jumper play vertikal_jump", "no policy 'vertikal_jump'"),
        ("jumper export vertikal_jump", "no policy 'vertikal_jump'"),
        ("jumper export vertical_jump --blend vertikal_jump 0.5", "no policy 'vertikal_jump'"),
        ("jumper train vertikal-jump", "unknown task 'vertikal-jump'"),
        ("jumper train vertical-jump --envs 64", "--envs is now --num-envs"),
        ("jumper train vertical-jump --init-policy vertikal_jump", "no policy 'vertikal_jump'"),
        ("jumper train vertical-jump --robot heavy.json", "heavy.json: no such file"),
        ("jumper evaluate vertical_jump --robot heavy.json", "heavy.json: no such file"),
        ("jumper evaluate logs/vertical-jump/RUN", "no such folder"),
        ("jumper evaluate horizontal_jump --suite gird", "no suite 'gird'"),
        ("jumper trian vertical-jump", "jumper has no command 'trian'"),
        ("python experiments/vertical_sweep.py", "experiments/vertical_sweep.py: no such file"),
        ("python experiments/template.py --jumps 10 --num-jumps 10", "--num-jumps"),
        ("python experiments/squat_hold.py --policy vertikal_jump", "no policy 'vertikal_jump'"),
        ("rerun outputs/jump.rrd", "outputs/jump.rrd: no such file"),
        ("make dmeo", "the Makefile has no target dmeo"),
        ('pip install "jumper-warp[gymnasum]"', "there is no extra 'gymnasum'"),
    ],
)
def test_wrong_command_fails_with_page_and_line(run, line, message):
    with pytest.raises(PageError, match=r"^page\.md:2: ") as error:
        run(bash(line))
    assert message in str(error.value)


def test_all_wrong_commands_of_a_page_are_reported(run):
    with pytest.raises(PageError, match=r"page\.md:2: .*\npage\.md:4: "):
        run(bash("jumper trian", "jumper list", "jumper paly"))


def test_python_fences_share_names_and_report_page_and_line(run):
    with pytest.raises(PageError, match=r"^page\.md:6: ZeroDivisionError: division by zero$"):
        run("```python\nvalue = 0\n```\n\n```python\n1 / value\n```\n```python\nraise SystemError\n```\n")


def test_syntax_error_is_reported_with_its_line(run):
    with pytest.raises(PageError, match=r"^page\.md:3: SyntaxError: "):
        run("```python\nvalue = 0\nvalue =\n```\n")


def test_warp_finds_the_source_of_functions_in_a_page(run):
    run(
        "# Title\n\n```python\nimport warp as wp\n\n\n@wp.kernel\ndef double(a: wp.array(dtype=float)):\n"
        "    a[wp.tid()] = 2.0 * a[wp.tid()]\n\n\na = wp.ones(2, dtype=float)\n"
        "wp.launch(double, 2, inputs=[a])\nassert list(a.numpy()) == [2.0, 2.0]\n```\n"
    )


def test_file_fences_are_written_and_tasks_forgotten_after_the_page(run, tmp_path):
    run(TASK + bash("jumper train my-jump --task-module my_task.py") + "```python\nimport my_task\n```\n")
    assert (tmp_path / "folder" / "my_task.py").read_text().startswith("# my_task.py\nfrom dataclasses")
    assert "my-jump" not in TASKS and "my_task" not in sys.modules


def test_file_of_another_language_is_named_in_a_comment(run):
    run(
        '<!-- file: heavy.json -->\n```json\n{"mass_kg": 20}\n```\n'
        "```python\nimport json\nassert json.load(open('heavy.json'))['mass_kg'] == 20\n```\n"
    )


def test_marked_commands_run_in_the_folder_of_the_page_with_extra_flags_for_training(run, tmp_path):
    run(
        bash("jumper train vertical-jump --no-randomize", note="<!-- run: --max-iterations 1 --num-envs 4 -->")
        + bash("jumper export logs/vertical-jump/*", "mkdir new", note="<!-- run -->")
    )
    folder = tmp_path / "folder"
    assert (folder / "new").is_dir() and len(list(folder.glob("logs/vertical-jump/*/policy/policy.onnx"))) == 1


@pytest.mark.parametrize("command", ["ls missing", "jumper info missing", "python missing.py"])
def test_marked_command_that_fails_is_reported_and_ends_the_page(run, command):
    with pytest.raises(PageError, match=r"^page\.md:3: [^\n]*missing[^\n]*$"):
        run(bash(command, "jumper trian", note="<!-- run -->"))


@pytest.mark.parametrize("note", ["<!-- skip: needs a GPU -->", "<!-- needs: no_such_module -->"])
def test_skipped_fences_do_not_run(run, note):
    run(f"{note}\n```python\nraise SystemError\n```\n")


def test_fence_runs_where_the_modules_that_it_needs_are_installed(run):
    with pytest.raises(PageError, match="SystemError"):
        run("<!-- needs: numpy, torch -->\n\n```python\nraise SystemError\n```\n")


@pytest.mark.parametrize("text", ["<!-- skip -->\n```python\n```\n", "```sh\nls\n```\n", "```py\nls\n```\n"])
def test_skip_without_reason_and_other_spellings_of_languages_fail(run, text):
    with pytest.raises(PageError, match=r"^page\.md:[12]: "):
        run(text)


def test_text_does_not_run(run):
    run("```text\njumper trian\n```\n```json\n{\n```\n```\nno language\n```\n")

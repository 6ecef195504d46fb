import shutil
import subprocess

import pytest

from cli_helpers import run
from jumper_warp.cli.main import COMMANDS

BASH = shutil.which("bash")


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    """File with the completion script for bash."""
    path = tmp_path_factory.mktemp("completion") / "jumper"
    with pytest.MonkeyPatch.context() as patch, path.open("w") as file:
        patch.setattr("sys.stdout", file)
        from jumper_warp.cli.completion import run as completion

        completion(["bash"])
    return path


def completed(script, *words):
    """Return what bash offers for the last of the words after `jumper`."""
    code = f'source {script}; COMP_WORDS=(jumper "$@"); COMP_CWORD=$#; _jumper; printf "%s\\n" "${{COMPREPLY[@]}}"'
    done = subprocess.run([BASH, "-uc", code, "bash", *words], capture_output=True, text=True)
    assert done.returncode == 0 and not done.stderr
    return done.stdout.split()


@pytest.mark.skipif(BASH is None, reason="no bash")
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["ev"], ["evaluate"]),
        ([""], list(COMMANDS)),
        (["train", "velocity-t"], ["velocity-trot"]),
        (["info", "vertical-jump-m"], ["vertical-jump-mars", "vertical-jump-mars-loose"]),
        (["train", "vertical-jump", "--num-e"], ["--num-envs"]),
        (["train", "vertical-jump", "--ppo.no-cl"], ["--ppo.no-clip-value"]),
        (["evaluate", "vertical_jump", "--height-r"], ["--height-range"]),
        (["train", "vertical-jump", "--trainer", "p"], ["ppo"]),
        (["sysid", "ex"], ["excite"]),
    ],
    ids=lambda words: " ".join(words),
)
def test_bash_completes(script, words, expected):
    assert completed(script, *words) == expected


@pytest.mark.skipif(BASH is None, reason="no bash")
@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_script_parses(capsys, shell):
    code, out, _ = run(capsys, "completion", shell)
    assert code == 0 and out.endswith("complete -o default -F _jumper jumper\n")
    assert ("bashcompinit" in out) is (shell == "zsh")
    assert subprocess.run([BASH, "-n"], input=out, text=True).returncode == 0

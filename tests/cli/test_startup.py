"""Start of the command `jumper`: what it imports, and its end by Ctrl-C."""

import os
import signal
import subprocess
import sys

import pytest

HEAVY = ("torch", "warp", "newton", "rerun", "scipy")
PRINT_IMPORTS = f"""
import sys
from jumper_warp.cli.main import main
try:
    main(sys.argv[1:])
except SystemExit:
    pass
print("imports", *(name for name in {HEAVY} if name in sys.modules))
"""


@pytest.mark.parametrize("args", [["--help"], ["list"], ["train", "--help"], ["trian"], ["--version"]])
def test_help_and_lists_import_no_simulator(args):
    run = subprocess.run([sys.executable, "-c", PRINT_IMPORTS, *args], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines()[-1].split() == ["imports"]


def test_interrupted_command_ends_with_130_and_no_traceback(tmp_path):
    arguments = "evaluate vertical_jump --device cpu --num-jumps 4096".split()
    run = subprocess.Popen(
        [sys.executable, "-m", "jumper_warp", *arguments], cwd=tmp_path, env=os.environ | {"PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a job in the background ignores it
    )  # fmt: skip
    first = run.stdout.readline()  # the command has begun
    run.send_signal(signal.SIGINT)
    rest = run.communicate()[0]
    assert first and run.returncode == 130
    assert "Traceback" not in rest

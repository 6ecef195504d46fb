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


INTERRUPTED_EXIT = """
import atexit, os, signal
from jumper_warp.cli.main import run_command

def interrupt():
    os.kill(os.getpid(), signal.SIGINT)

atexit.register(interrupt)
run_command(interrupt)
"""


def test_a_second_interrupt_while_the_process_ends_prints_no_traceback():
    run = subprocess.run(
        [sys.executable, "-c", INTERRUPTED_EXIT], capture_output=True, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a job in the background ignores it
    )  # fmt: skip
    assert (run.stderr, run.returncode) == ("", -signal.SIGINT)


INTERRUPTED_IMPORT = """
import signal, sys
from importlib.abc import MetaPathFinder
from jumper_warp.utils.startup import prepare_imports
class Interrupt(MetaPathFinder):
    def find_spec(self, name, *_):
        if name == "networkx":
            signal.raise_signal(signal.SIGINT)
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
prepare_imports()
sys.meta_path.insert(0, Interrupt())
try:
    import trimesh
except KeyboardInterrupt:
    print("interrupted")
"""


def test_ctrl_c_during_an_import_that_catches_all_exceptions_ends_the_command():
    run = subprocess.run([sys.executable, "-c", INTERRUPTED_IMPORT], capture_output=True, text=True, check=True)
    assert run.stdout == "interrupted\n"

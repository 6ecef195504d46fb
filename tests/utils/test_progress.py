import os
import pty
import subprocess
import sys

from jumper_warp.utils.progress import phase

CODE = """
import time
from jumper_warp.utils.progress import phase, shown

shown("alone", time.sleep)(0.3)
with phase("outer", 4) as advance:
    advance(2)
    with phase("inner") as step:
        step()
        shown("hidden", time.sleep)(0.3)
    print("result")
"""


def test_phases_print_nothing_where_standard_error_is_no_terminal(capsys):
    with phase("outer", 2) as advance, phase("inner"):
        advance()
    assert capsys.readouterr() == ("", "")


def test_phases_show_on_a_terminal_and_leave_standard_output_alone():
    reader, terminal = pty.openpty()
    process = subprocess.run([sys.executable, "-c", CODE], stdout=subprocess.PIPE, stderr=terminal, text=True)
    os.close(terminal)
    shown = b""
    while part := _read(reader):
        shown += part
    assert process.stdout == "result\n"
    assert all(title in shown for title in (b"alone", b"outer", b"inner"))
    assert b"hidden" not in shown and b"result" not in shown


def _read(reader):
    """Return some bytes of a terminal, empty at its end."""
    try:
        return os.read(reader, 65536)
    except OSError:
        return b""

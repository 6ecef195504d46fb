"""Server and window of the Rerun viewer, on this machine's loopback address only.

A file `rerun.py` of the working directory must not be imported in place of Rerun: Python gets -P.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from socket import create_connection, socket
from typing import Any
from urllib.parse import quote

LOOPBACK = "127.0.0.1"
SERVER_MEMORY = "500MB"  # of the server, which buffers data for viewers that join later; it drops the oldest
VIEWER_MEMORY = "1GB"  # of a viewer, which drops the oldest data too
SERVER_START = 30.0  # [s] Longest time until the server answers
KEEPER = """
import os, signal, subprocess, sys
server = subprocess.Popen([sys.executable, "-P", "-m", "rerun", *sys.argv[1:]], start_new_session=True)
sys.stdin.read()
os.killpg(server.pid, signal.SIGTERM)
"""  # Program that ends the server with the process that started it, even if this one is killed
QUIET: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


class RerunServer:
    """Server on this machine's loopback address that keeps the newest data for viewers that join later.

    url: for the Rerun viewer; page: the same in a browser.
    """

    def __init__(self) -> None:
        """Start the server and wait until it listens. Raises OSError: it does not."""
        port, page = (free_port() for _ in range(2))
        command = [sys.executable, "-P", "-c", KEEPER, "--serve-web", "--bind", LOOPBACK, "--port", str(port)]
        command += ["--web-viewer-port", str(page), "--server-memory-limit", SERVER_MEMORY]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, **QUIET)
        self.url = f"rerun+http://{LOOPBACK}:{port}/proxy"
        self.page = f"http://{LOOPBACK}:{page}/?url={quote(self.url, safe='')}"
        begin = time.monotonic()
        while not is_served(self.url):
            if time.monotonic() > begin + SERVER_START:
                raise OSError(f"the Rerun server does not answer at {self.url}")
            time.sleep(0.05)

    def close(self) -> None:
        """End the server."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def free_port() -> int:
    """Return a TCP port of the loopback address that no process uses."""
    with socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


def is_served(url: str) -> bool:
    """Return whether a server listens at the address of `RerunServer.url`."""
    try:
        create_connection((LOOPBACK, int(port_of(url))), 1.0).close()
    except (OSError, IndexError, ValueError, OverflowError):  # no server, or no such address
        return False
    return True


def has_display() -> bool:
    """Return whether windows can be opened: on Linux a display is set."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def viewer_command(source: str | Path) -> list[str]:
    """Return the command that opens a window of the Rerun viewer for a file or the address of a server."""
    options = ["--bind", LOOPBACK, "--port", "auto", "--memory-limit", VIEWER_MEMORY]
    return [sys.executable, "-P", "-m", "rerun", str(source), *options]


def announce(url: str, page: str) -> subprocess.Popen | None:
    """Print the addresses of a live view; open and return a window of the Rerun viewer, if url is for it.

    The window outlives this process. None: there is no display, or the view is a page only.
    """
    ports = " ".join(f"-L {part}:{LOOPBACK}:{part}" for part in dict.fromkeys((port_of(page), port_of(url))))
    print(f"watch: {page} in a browser; on another computer after ssh {ports} HOST", file=sys.stderr, flush=True)
    if not has_display() or not url.startswith("rerun"):
        return None
    return subprocess.Popen(viewer_command(url), stdin=subprocess.DEVNULL, start_new_session=True, **QUIET)


def port_of(address: str) -> str:
    """Return the port in a URL of the loopback address."""
    return address.split(f"{LOOPBACK}:")[1].partition("/")[0]

"""Measure the page on which a visitor drives the robot: bytes, start, policy steps and frames.

    python experiments/page_speed.py --page docs/_build/html/drive

Headless Chromium opens the page from a server that compresses files, over a line of limited rate, and lets the robot
walk and jump. `make page` builds the page.
"""

from __future__ import annotations

import gzip
import http.server
import os
import shutil
import threading
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from jumper_warp.utils.output import output_dir
from support.scripts import OutputArgs, report, run_script

GRAPHICS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]  # Flags of a machine without GPU
DRIVE = 20.0  # [s] Time over which policy steps are measured


@dataclass(frozen=True)
class Args(OutputArgs):
    """Measure the page on which a visitor drives the robot."""

    page: Path = Path("docs/_build/html/drive")  # Folder of the page
    rate: float = 50.0  # Rate of the line [Mbit/s]
    runs: int = 3  # Number of times that the page is opened
    size: tuple[int, int] = (1280, 720)  # Width and height of the window [px]


@cache
def compressed(path: str) -> bytes:
    """Return the content of a file, compressed by gzip."""
    return gzip.compress(Path(path).read_bytes(), 9)


class Server(http.server.SimpleHTTPRequestHandler):
    """Handler that compresses files, and counts the bytes sent in `sent`."""

    sent = 0

    def do_GET(self) -> None:
        """Send a file."""
        path = self.translate_path(self.path)
        data = compressed(os.path.join(path, "index.html") if os.path.isdir(path) else path)
        self.send_response(200)
        self.send_header("Content-Type", self.guess_type(path if not os.path.isdir(path) else "index.html"))
        self.send_header("Content-Encoding", "gzip")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)
        type(self).sent += len(data)

    def log_message(self, *args: Any) -> None:  # pyright: ignore
        """Print nothing."""


def measure(browser: Any, address: str, args: Args) -> dict[str, float]:
    """Open the page in a new context, drive for some time, and return the measurements by name."""
    Server.sent = 0
    width, height = args.size
    context = browser.new_context(viewport={"width": width, "height": height})
    page = context.new_page()
    page.set_default_timeout(120_000.0)
    line = context.new_cdp_session(page)
    line.send("Network.enable")
    speed = args.rate * 1.0e6 / 8.0
    limits = {"offline": False, "latency": 20, "downloadThroughput": speed, "uploadThroughput": speed}
    line.send("Network.emulateNetworkConditions", limits)
    begin = time.perf_counter()
    page.goto(address)
    page.wait_for_function("page.state")
    start = time.perf_counter() - begin
    sent = Server.sent
    page.keyboard.down("w")
    time.sleep(0.5 * DRIVE)
    page.keyboard.up("w")
    page.keyboard.press(" ")
    time.sleep(0.5 * DRIVE)
    page.evaluate("page.send('times')")
    page.wait_for_function("page.times")
    values = page.evaluate(
        """() => ({
            step_median_ms: page.times.median, step_p99_ms: page.times.p99, steps: page.times.count,
            draw_calls: page.scene.renderer.info.render.calls, frame_ms: page.scene.frameTime,
            script_median_ms: [...page.script].sort((a, b) => a - b)[page.script.length >> 1], ratio: page.scene.ratio,
        })"""
    )
    context.close()
    return {"start_s": start, "transfer_mb": 1.0e-6 * sent, **values}


def main(args: Args) -> None:
    """Measure the page several times, and report all values."""
    from playwright.sync_api import sync_playwright

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), lambda *each: Server(*each, directory=str(args.page)))
    for file in args.page.rglob("*"):
        if file.is_file():
            compressed(str(file))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    metrics = {}
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=GRAPHICS)
        for run in range(args.runs):
            values = measure(browser, f"http://127.0.0.1:{server.server_port}/", args)
            metrics |= {f"{name}_{run}": value for name, value in values.items()}
        browser.close()
    metrics["load_of_machine"] = os.getloadavg()[0]
    report(args, output_dir("page_speed", args.out), metrics, f"{args.runs} openings of {args.page}", metrics)


if __name__ == "__main__":
    run_script(main, Args)

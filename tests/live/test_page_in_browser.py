"""The page on which a visitor drives the robot, in headless Chromium, served by `http.server`."""

import functools
import http.server
import os
import shutil
import threading
from pathlib import Path

import pytest

from jumper_warp.live.site import browser_files, write_page
from jumper_warp.policies.policy import Policy

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
if CHROMIUM is None and not os.environ.get("REQUIRE_CHROMIUM"):
    pytest.skip("no Chromium: tests in the browser are skipped", allow_module_level=True)
BUILT = (Path(__file__).parents[2] / "jumper_warp" / "live" / "page" / "dist").is_dir()
if not BUILT and not os.environ.get("REQUIRE_PAGE"):
    pytest.skip("the page is not built (make page): its tests are skipped", allow_module_level=True)
GRAPHICS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]


class Handler(http.server.SimpleHTTPRequestHandler):
    """Handler that prints nothing."""

    def log_message(self, *args):
        pass


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """Return the address of a server of the page."""
    folder = write_page(tmp_path_factory.mktemp("page")).parent
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=folder))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture(scope="module")
def browser():
    """Return a headless Chromium."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=GRAPHICS)
        yield browser
        browser.close()


def opened(browser, address, **options):
    """Return the page, opened, with the errors of its console and its requests elsewhere as `errors`."""
    page = browser.new_page(**options)
    page.set_default_timeout(120_000.0)  # [ms] of a busy machine without a GPU
    page.errors = []
    page.on("pageerror", lambda error: page.errors.append(str(error)))
    page.on("console", lambda entry: page.errors.append(entry.text) if entry.type in ("error", "warning") else None)
    page.on("request", lambda each: each.url.startswith((address, "data:")) or page.errors.append(each.url))
    page.goto(address)
    page.wait_for_function("page.state")
    return page


@pytest.fixture(scope="module")
def visitor(browser, address):
    """Return the page at the size of a small window."""
    return opened(browser, address, viewport={"width": 640, "height": 400})


@pytest.fixture(autouse=True)
def standing(visitor):
    """Reset the robot before each test."""
    visitor.keyboard.press("r")
    visitor.wait_for_function("Math.hypot(...page.state.position.slice(0, 2)) < 0.02 && !page.state.fallen")


def window_point(page, x, y):
    """Return the point of the window [px] at a place [m] on the ground."""
    return page.evaluate(
        """([x, y]) => {
            const point = page.scene.position.clone().set(x, y, 0).project(page.scene.camera);
            return [(0.5 + 0.5 * point.x) * innerWidth, (0.5 - 0.5 * point.y) * innerHeight];
        }""",
        [x, y],
    )


def landing_error(page, jumps):
    """Wait for the outcome of a jump, and return its distance from the goal [m]."""
    page.wait_for_function(f"page.jumps.length === {jumps + 1}")
    jump = page.evaluate("page.jumps.at(-1)")
    assert jump["made"]
    return jump["error"]


def test_robot_walks_while_a_key_is_held(visitor):
    visitor.keyboard.down("w")
    visitor.wait_for_function("page.state.position[0] > 0.4")
    visitor.keyboard.up("w")
    visitor.wait_for_function("Math.hypot(...page.state.velocity) < 0.05")


def test_click_makes_the_robot_jump_there(visitor):
    jumps = len(visitor.evaluate("page.jumps"))
    visitor.mouse.click(*window_point(visitor, 0.8, 0.1))
    visitor.wait_for_function("page.state.goal !== null")
    assert visitor.evaluate("page.state.goal") == pytest.approx([0.8, 0.1], abs=0.03)
    assert landing_error(visitor, jumps) < 0.05


def test_fallen_robot_stays_above_the_ground_until_reset(visitor):
    visitor.evaluate("page.send('push', { force: [0, 400, 0], seconds: 0.3 })")
    visitor.wait_for_function("page.state.fallen")
    height = visitor.evaluate("page.state.height")
    assert "It fell" in visitor.locator("#hint").text_content()
    assert visitor.locator("#status").text_content() == "fell"
    visitor.wait_for_timeout(500)  # [ms]
    assert visitor.evaluate("page.state.fallen") and visitor.evaluate("page.state.height") == height > 0.05
    visitor.keyboard.press("r")
    visitor.wait_for_function("!page.state.fallen && page.state.height > 0.35")
    assert "It fell" not in visitor.locator("#hint").text_content()


DROP = """async (folder) => {
    const data = new DataTransfer();
    for (const name of ["policy.json", "policy.bin"]) {
        const answer = await fetch(`${folder}/${name}`);
        data.items.add(new File([await answer.arrayBuffer()], name));
    }
    dispatchEvent(new DragEvent("drop", { dataTransfer: data, cancelable: true }));
}"""
"""Function of the page that drops the two files of a policy onto it."""


def test_dropped_policy_runs_and_a_damaged_one_is_one_line(visitor, tmp_path):
    visitor.evaluate(DROP, "policies/walking")
    visitor.wait_for_function("document.getElementById('names').textContent.includes('walking')")
    visitor.wait_for_function("page.state && !page.state.fallen")
    policy = tmp_path / "mine"
    policy.mkdir()
    for file, content in browser_files(Policy.load("walking"), "mine").items():
        (policy / file).write_bytes(content)
    visitor.locator("#files").set_input_files(policy)
    visitor.wait_for_function("document.getElementById('names').textContent.includes('mine')")
    data = bytearray((policy / "policy.bin").read_bytes())
    data[1000] ^= 64
    (policy / "policy.bin").write_bytes(data)
    visitor.locator("#files").set_input_files(policy)
    visitor.wait_for_function("document.getElementById('hint').textContent === 'mine: policy.bin is damaged'")
    (policy / "policy.json").write_text("{")
    visitor.locator("#files").set_input_files(policy)
    visitor.wait_for_function("document.getElementById('hint').textContent.startsWith('policy.json is damaged')")


def test_console_has_no_errors_and_nothing_is_fetched_elsewhere(visitor):
    assert [error for error in visitor.errors if "GPU stall" not in error] == []
    assert visitor.evaluate("page.scene.renderer.info.render.calls") <= 60


def test_phone_walks_and_jumps_by_touch(browser, address, visitor):
    visitor.close()  # leaves the processor to the phone
    phone = opened(browser, address, viewport={"width": 390, "height": 700}, has_touch=True, is_mobile=True)
    stick = phone.locator("#stick").bounding_box()
    middle = (stick["x"] + 58, stick["y"] + 58)
    phone.mouse.move(*middle)
    phone.mouse.down()
    phone.mouse.move(middle[0], middle[1] - 50)
    phone.wait_for_function("page.state.position[0] > 0.2")
    phone.mouse.up()
    phone.wait_for_function("Math.hypot(...page.state.velocity) < 0.05")
    x, y, _ = phone.evaluate("page.state.position")
    phone.touchscreen.tap(*window_point(phone, x + 0.6, y - 0.3))
    assert landing_error(phone, 0) < 0.05
    assert phone.errors == [] or all("GPU stall" in error for error in phone.errors)

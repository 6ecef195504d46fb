"""The page on which a visitor drives the robot, in headless Chromium, served by `http.server`."""

import functools
import http.server
import itertools
import os
import shutil
import threading
from pathlib import Path

import numpy as np
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


def test_space_makes_the_robot_jump_to_the_height(visitor):
    jumps = len(visitor.evaluate("page.jumps"))
    visitor.keyboard.press(" ")
    assert abs(landing_error(visitor, jumps)) < 0.02
    assert "0.90 m asked" in visitor.locator("#figures").inner_text()
    assert visitor.evaluate("page.scene.ghost.visible")
    visitor.locator("#height").press("End")
    assert visitor.locator("#height-value").inner_text() == "1.10 m"
    visitor.keyboard.press(" ")
    assert not visitor.evaluate("page.scene.ghost.visible")
    visitor.wait_for_function("page.state.phase === 1")
    visitor.keyboard.press("r")
    visitor.wait_for_function("page.state.phase === undefined && !document.getElementById('figures').textContent")
    visitor.locator("#height").fill("0.9")


def test_new_target_walk_and_reset_clear_what_a_far_target_showed(visitor):
    hint, figures = visitor.locator("#hint"), visitor.locator("#figures")
    distance = "page.scene.camera.position.distanceTo(page.scene.orbit.target)"
    first = visitor.evaluate(distance)
    visitor.mouse.click(*window_point(visitor, 2.5, 0.1))
    assert "Too far" in hint.text_content() and "m away" in figures.text_content()
    visitor.wait_for_function("page.state.waiting")
    visitor.mouse.click(*window_point(visitor, 0.9, 0.1))
    assert "Too far" not in hint.text_content()
    visitor.keyboard.press("d", delay=200)  # [ms]
    visitor.wait_for_function("!page.state.waiting")
    assert figures.text_content() == ""
    visitor.mouse.wheel(0, 500)
    visitor.wait_for_function(f"{distance} > {first + 0.5}")
    visitor.mouse.click(*window_point(visitor, 2.5, 0.1))
    visitor.wait_for_function("page.state.waiting && document.getElementById('figures').textContent")
    visitor.keyboard.press("r")
    visitor.wait_for_function(f"Math.abs({distance} - {first}) < 0.1")
    visitor.wait_for_function("!document.getElementById('figures').textContent")
    assert "Too far" not in hint.text_content()


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


def test_gamepad_walks_turns_jumps_pushes_and_resets(visitor):
    visitor.evaluate("""() => {
        window.pad = { axes: [0.1, -1, -1, 0], buttons: [0, 0, 0].map(() => ({ pressed: false })) };
        navigator.getGamepads = () => [null, pad];
    }""")
    visitor.wait_for_function("page.state.position[0] > 0.2 && page.state.yaw > 0.3")
    visitor.evaluate("pad.axes = [0.1, 0.1, -0.1, 0]")
    visitor.wait_for_function("Math.hypot(...page.state.velocity) < 0.05")
    jumps = len(visitor.evaluate("page.jumps"))
    press = "button => { pad.buttons.forEach((each, i) => { each.pressed = i === button; }); }"
    visitor.evaluate(press, 0)
    assert abs(landing_error(visitor, jumps)) < 0.03
    visitor.wait_for_timeout(300)  # [ms]
    assert visitor.evaluate("page.state.skill") == "walk" and not visitor.evaluate("page.state.waiting")  # acts once
    visitor.evaluate(press, 1)
    visitor.wait_for_function("Math.hypot(...page.state.velocity) > 0.15")
    visitor.evaluate(press, 2)
    visitor.wait_for_function("Math.hypot(...page.state.position.slice(0, 2)) < 0.02")
    visitor.evaluate("delete navigator.getGamepads")


def test_push_and_drag_are_survived(visitor):
    visitor.keyboard.press("p")
    visitor.wait_for_function("Math.hypot(...page.state.velocity) > 0.15")
    visitor.wait_for_function("Math.hypot(...page.state.velocity) < 0.05")
    point = np.array(window_point(visitor, *visitor.evaluate("page.state.position.slice(0, 2)"))) - [0, 45]
    visitor.mouse.move(*point)
    visitor.mouse.down()
    visitor.mouse.move(*(point + [40, 0]), steps=4)
    visitor.wait_for_function("Math.hypot(...page.state.velocity) > 0.1")
    visitor.mouse.up()
    visitor.wait_for_function("Math.hypot(...page.state.velocity) < 0.05")
    assert not visitor.evaluate("page.state.fallen")


def test_walk_slips_at_low_friction(visitor):
    friction = visitor.locator("#friction")
    visitor.locator("summary").click()
    visitor.keyboard.down("w")
    visitor.wait_for_function("page.state.position[0] > 0.7")
    assert "walks" in visitor.locator("#status").inner_text()
    friction.fill("0.3")
    visitor.wait_for_function("document.getElementById('status').textContent.startsWith('slips')")
    visitor.keyboard.up("w")
    friction.fill("0.85")
    visitor.locator("summary").click()


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
    visitor.evaluate(DROP, "policies/walking_rough")
    visitor.wait_for_function("document.getElementById('names').textContent.includes('walking_rough')")
    visitor.wait_for_function("page.state && !page.state.fallen")
    policy = tmp_path / "mine"
    policy.mkdir()
    for file, content in browser_files(Policy.load("walking_flat"), "mine").items():
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


def test_mars_has_its_own_policies(visitor):
    visitor.locator("summary").click()
    visitor.select_option("#scene", "mars")
    visitor.wait_for_function("page.opened === 'mars'")
    assert "mars_vertical_jump" in visitor.locator("#names").inner_text()
    assert visitor.locator("#gravity-value").inner_text() == "Mars"
    visitor.select_option("#scene", "plain")
    visitor.wait_for_function("page.opened === 'plain'")
    visitor.locator("summary").click()


def test_console_has_no_errors_and_nothing_is_fetched_elsewhere(visitor):
    assert [error for error in visitor.errors if "GPU stall" not in error] == []
    assert visitor.evaluate("page.scene.renderer.info.render.calls") <= 60


def overlapping(page, *selectors):
    """Return the pairs of elements whose boxes overlap, or leave the window's width."""
    ends = {}
    for name in selectors:
        box = page.locator(name).bounding_box()
        ends[name] = (box["x"], box["x"] + box["width"], box["y"], box["y"] + box["height"])
    outside = [name for name, (left, right, *_) in ends.items() if left < 0 or right > page.viewport_size["width"]]
    return outside + [
        (one, other)
        for one, other in itertools.combinations(ends, 2)
        if all(ends[one][i] < ends[other][i + 1] and ends[other][i] < ends[one][i + 1] for i in (0, 2))
    ]


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
    for width, height in ((390, 844), (844, 390)):
        phone.set_viewport_size({"width": width, "height": height})
        assert overlapping(phone, "#stick", "#bar", "#hint", "#figures", "summary") == []
        phone.wait_for_timeout(300)  # [ms] of a frame in the new size
        _, robot = window_point(phone, *phone.evaluate("page.state.position.slice(0, 2)"))
        hint = phone.locator("#hint").bounding_box()
        assert not hint["y"] - 40 < robot < hint["y"] + hint["height"]
        phone.locator("summary").tap()
        assert overlapping(phone, "#stick", "#jumpUp", "#panel") == []
        phone.locator("#speed").tap()  # scrolls to it
        assert phone.locator("#speed-value").inner_text() == "0.55 ×"
        phone.locator("#speed").fill("1")
        phone.touchscreen.tap(300, height - 150)  # beside the settings: closes them only
        assert not phone.evaluate("panel.open || page.state.waiting")
    assert phone.errors == [] or all("GPU stall" in error for error in phone.errors)

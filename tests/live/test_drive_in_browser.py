"""The page of `jumper drive` in headless Chromium: keys, clicks, sliders, visitors, recordings and messages of others.

The tests share one robot and one page, since both take seconds to start.
"""

import asyncio
import os
import shutil
import threading
import time

import msgspec
import numpy as np
import pytest
import viser
import websockets
import zstandard
from rerun.chunk import RrdReader

from drive_helpers import session_of
from jumper_warp.evaluation.skills import SkillNames
from jumper_warp.live.page import KEY_LABEL, Page
from jumper_warp.viz.viser import ORIGIN, open_server

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
if CHROMIUM is None and not os.environ.get("REQUIRE_CHROMIUM"):
    pytest.skip("no Chromium: tests in the browser are skipped", allow_module_level=True)

PROTOCOL = f"viser-v{viser.__version__}"
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [1, 1, 1], "fov": 1.0, "near": 0.1, "far": 100.0,
    "image_height": 600, "image_width": 800, "look_at": [0, 0, 0], "up_direction": [0, 0, 1],
}  # fmt: skip
"""Message with which a page introduces itself."""
GRAPHICS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Return the running page of a robot that walks and jumps."""
    names = SkillNames()
    session = session_of(names.walk, names.jump_up, names.jump_to)
    server = open_server(0)
    page = Page(server, session, tmp_path_factory.mktemp("recordings"))
    server.scene.configure_default_lights(cast_shadow=False)  # for software rendering on few cores
    thread = threading.Thread(target=page.run, daemon=True)
    thread.start()
    yield page
    page.stopped = True
    thread.join()
    server.stop()


@pytest.fixture(scope="module")
def browser():
    """Return a headless Chromium."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=GRAPHICS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def driver(page, browser):
    """Return the browser's page of the first visitor, with the errors in its console as `errors`."""
    visitor = browser.new_page(viewport={"width": 1200, "height": 700}, device_scale_factor=0.25)
    visitor.set_default_timeout(120_000.0)  # [ms] of a busy machine without a GPU
    visitor.errors = []
    visitor.on("pageerror", lambda error: visitor.errors.append(str(error)))
    visitor.on("console", lambda entry: visitor.errors.append(entry.text) if entry.type == "error" else None)
    visitor.goto(f"http://127.0.0.1:{page.server.get_port()}")
    visitor.get_by_role("button", name="T jump up").wait_for()
    visitor.add_style_tag(content="#webgl-software-rendering { display: none }")  # a notice that covers controls
    return visitor


@pytest.fixture(autouse=True)
def standing(page, driver):
    """Reset the robot before each test."""
    page.post(page.session.reset)
    wait_for(lambda: abs(page.session.position[0]) < 0.02)


def wait_for(condition, seconds=60.0):
    """Wait until a condition holds; fail after some time [s]."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the condition does not hold"
        time.sleep(0.02)


def test_robot_walks_while_a_key_is_held(page, driver):
    driver.keyboard.down("i")
    wait_for(lambda: page.session.position[0] > 0.3)
    driver.keyboard.up("i")
    wait_for(lambda: not page.session.velocity.any() and not page.session.command.any())


def test_click_makes_the_robot_jump_there(page, driver):
    canvas = driver.locator("canvas").first.bounding_box()
    driver.mouse.click(canvas["x"] + 0.62 * canvas["width"], canvas["y"] + 0.72 * canvas["height"])
    wait_for(lambda: page.session.jump is not None)
    goal = page.session.jump.goal
    assert 0.2 < np.linalg.norm(goal) < 3.0
    wait_for(lambda: page.session.jump is None)
    assert np.linalg.norm(page.session.position[:2] - goal) < 0.05


async def intrude(page, messages):
    """Connect as another visitor, send messages, and return the texts and the labels of controls that it receives."""
    address = f"ws://127.0.0.1:{page.server.get_port()}"
    decompress = zstandard.ZstdDecompressor().decompress
    texts = []
    options = {"origin": "http://localhost:8080", "subprotocols": [PROTOCOL], "max_size": None}
    async with websockets.connect(address, **options) as socket:
        for message in (CAMERA, *messages):
            await socket.send(msgspec.msgpack.encode(message))
        end = time.monotonic() + 2.0
        while time.monotonic() < end:
            data = await socket.recv()
            size, packed = (int.from_bytes(data[i : i + 8], "little") for i in (0, 8))
            content = msgspec.msgpack.decode(decompress(data[16 : 16 + packed], max_output_size=size))
            properties = [message.get("props", {}) for message in content["messages"]]
            texts += [each.get("_markdown") or each.get("label") or "" for each in properties]
    return texts


def test_another_visitor_has_no_controls_and_its_messages_are_ignored(page, driver):
    """Even messages that name the driver's own sliders, buttons, keys and scene change nothing."""
    gui = page.visitors[next(iter(page.visitors))].gui
    handles = gui._gui_input_handle_from_uuid.values()
    values = {"TextHandle": "i", "SliderHandle": 1.0, "ButtonHandle": True}
    messages = [
        {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}}
        for handle in handles
        for kind, value in values.items()
        if type(handle).__name__ == f"Gui{kind}"
    ]
    messages += [{"type": "CommandTriggerMessage", "uuid": uuid} for uuid in gui._command_handle_from_uuid]
    messages.append({
        "type": "ScenePointerMessage", "event_type": "click", "ray_origin": [0, 0, 2], "ray_direction": [0.3, 0, -1],
        "screen_pos": [[0.5, 0.5]], "modifier": None,
    })  # fmt: skip
    assert len(messages) > 10
    session = page.session
    before = (dict(session.values), page.paused, page.speed, page.take)
    texts = asyncio.run_coroutine_threadsafe(intrude(page, messages), page.server.get_event_loop()).result(30.0)
    assert any("You are watching" in text for text in texts)
    assert not {"forward [m/s]", "T jump up", KEY_LABEL} & set(texts)
    assert (session.values, page.paused, page.speed, page.take) == before
    assert session.jump is None
    assert not session.velocity.any()
    assert np.linalg.norm(session.position[:2]) < 0.02
    wait_for(lambda: len(page.visitors) == 1)


def test_other_origins_and_tunnels_are_refused(page, driver):
    from viser._messages import ShareUrlRequest

    async def connect(origin):
        address = f"ws://127.0.0.1:{page.server.get_port()}"
        async with websockets.connect(address, origin=origin, subprotocols=[PROTOCOL]):
            pass

    for origin in ("http://example.com", "http://localhost.example.com:8080", None):
        with pytest.raises(websockets.InvalidStatus, match="403"):
            asyncio.run_coroutine_threadsafe(connect(origin), page.server.get_event_loop()).result(30.0)
    assert ORIGIN.fullmatch("http://localhost:9000")
    assert ShareUrlRequest not in page.server._websock_server._incoming_handlers
    assert page.server.get_host() == "127.0.0.1"


def test_console_has_no_errors(driver):
    assert driver.errors == []


def test_recording_yields_a_page_a_rerun_file_and_a_film_that_play(page, driver, browser):
    """The last test: it leaves the page."""
    driver.keyboard.press("v")
    wait_for(lambda: page.take is not None and page.take.frames > 20)
    path = page.take.path
    driver.keyboard.press("v")
    wait_for(path.with_suffix(".html").exists)
    driver.goto("about:blank")  # leaves the processor to the film
    wait_for(path.with_suffix(".mp4").exists, 120.0)
    chunks = RrdReader(path.with_suffix(".rrd")).stream().to_chunks()
    assert any("torque" in str(chunk.entity_path) for chunk in chunks)
    player = browser.new_page(viewport={"width": 400, "height": 300}, device_scale_factor=0.25)
    errors = []
    player.on("pageerror", lambda error: errors.append(str(error)))
    player.goto(f"file://{path}.html")
    player.locator("canvas").first.wait_for()
    import imageio.v3

    frames = imageio.v3.imread(path.with_suffix(".mp4"), plugin="FFMPEG")
    assert len(frames) >= 8
    assert frames[0].std() > 10.0  # not one colour
    assert not errors
    player.close()

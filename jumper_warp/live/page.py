"""Page in the browser on which a person drives a robot: scene, controls of the driver, plots and recordings.

Every visitor sees the scene and the plots. The controls exist only for the driver, in that visitor's own interface, so
that viser does not know them in messages of other visitors.
"""

from __future__ import annotations

import html
import queue
import time
from collections.abc import Callable
from functools import cache, partial
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from jumper_warp.evaluation.trained import trained_bounds
from jumper_warp.live.plots import Plots
from jumper_warp.live.recordings import Take
from jumper_warp.live.session import GROUNDS, MAX_VALUES, Session
from jumper_warp.robot.model import build_model
from jumper_warp.utils.errors import InputError
from jumper_warp.viz.shapes import shape_meshes
from jumper_warp.viz.viser import ViserScene

if TYPE_CHECKING:
    from pathlib import Path

    from viser import ClientHandle, ViserServer

KEYS = {"i": (0, 1.0), "k": (0, -1.0), "u": (1, 1.0), "o": (1, -1.0), "j": (2, 1.0), "l": (2, -1.0)}
"""Component of the velocity and its sign by key: I ahead, K back, U, O to the sides, J, L turn."""
KEY_SPEEDS = np.array([0.6, 0.4, 0.8])  # [m/s], [m/s], [rad/s] Of a held key, and of a gamepad's full deflection
KEY_LABEL = "Keys, gamepad"  # Label of the text field through which the page's script sends keys and gamepad
HELP = "**I K** ahead, back · **J L** turn · **U O** sideways · **T** jump up · **click** jump there · **R** reset"
PLOT_EVERY, REDRAW_EVERY = (3, 6)  # Policy steps between points of the plots, and between updates of one of them
LATE = 0.1  # [s] Delay after which the clock restarts, instead of catching up


class Page:
    """Page of a session, served by a viser server; `run` advances both in real time."""

    def __init__(self, server: ViserServer, session: Session, folder: Path) -> None:
        """Build scene and plots; the first visitor drives. folder: for recordings."""
        self.server = server
        self.session = session
        self.folder = folder
        self.requests: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self.visitors: dict[int, ClientHandle] = {}  # By id, in order of arrival; the first one drives
        self.speed = 1.0  # Simulated over real time
        self.paused = False
        self.stopped = False  # Whether `run` ends
        self.steps = 0
        self.take: Take | None = None  # The recording under way
        self.status = server.gui.add_markdown("", order=-1.0)
        self.draw_ground()
        self.plots = Plots(server, session, PLOT_EVERY)
        server.gui.main_panel.dock_right()
        server.on_client_connect(lambda client: self.post(self.enter, client))
        server.on_client_disconnect(lambda client: self.post(self.leave, client.client_id))

    def post(self, action: Callable[..., object], *args: object) -> None:
        """Run an action before the next step, in the thread of `run`; callbacks of viser have threads of their own."""
        self.requests.put(partial(action, *args))

    def draw_ground(self) -> None:
        """Draw the robot and the session's ground, in place of those drawn before."""
        ground = "plane" if self.session.field is None else self.session.field
        model = build_model(1, description=self.session.env.sim.descriptions, ground=ground, device="cpu", mujoco=False)
        self.scene = ViserScene(self.server.scene, shape_meshes(model, (0,)))
        self.model = model
        self.shown_goal: np.ndarray | None = None
        self.show()

    # ------------------------------------------------------------------ visitors

    def enter(self, client: ClientHandle) -> None:
        """Give a new visitor the controls, if no one drives, else a notice."""
        self.visitors[client.client_id] = client
        if len(self.visitors) == 1:
            Controls(self, client)
        else:
            client.gui.add_markdown("**You are watching.** Another visitor drives; you can turn the view.", order=0.0)

    def leave(self, visitor: int) -> None:
        """Stop the robot if its driver leaves, and give the next visitor the controls."""
        drove = next(iter(self.visitors), None) == visitor
        self.visitors.pop(visitor, None)
        if drove:
            self.session.velocity = np.zeros(3)
            for client in list(self.visitors.values())[:1]:
                client.gui.reset()
                Controls(self, client)

    # ------------------------------------------------------------------ loop

    def run(self) -> None:
        """Simulate and show in real time until `stopped`; nothing is simulated while there is no visitor."""
        dt = self.session.env.step_dt
        due = time.perf_counter()
        while not self.stopped:
            while not self.requests.empty():
                try:
                    self.requests.get()()
                except InputError as error:
                    self.notify("Refused", str(error))
            if self.visitors and not self.paused:
                self.advance()
            due += dt / self.speed
            wait = due - time.perf_counter()
            if wait > 0.0:
                time.sleep(wait)
            elif wait < -LATE:
                due = time.perf_counter()

    def advance(self) -> None:
        """Advance the session by one policy step, and show and record it."""
        self.session.step()
        self.steps += 1
        with self.server.atomic():
            self.show()
            if self.steps % PLOT_EVERY == 0:
                self.plots.sample(self.session)
            if self.steps % REDRAW_EVERY == 0:
                self.plots.redraw()
                self.show_status()
        self.server.flush()
        if self.take is not None and not self.take.add(self.session):
            self.finish_take()

    def show(self) -> None:
        """Show the robot and its goal; the viewer's origin follows the robot over the ground."""
        session = self.session
        x, y = session.position[:2]
        self.scene.follow(np.array([x, y, float(session.surface(np.array([x]), np.array([y]))[0])]))
        self.scene.update(session.poses)
        goal = None if session.jump is None else session.jump.goal
        if goal is not self.shown_goal:
            self.shown_goal = goal
            self.scene.show_goals([] if goal is None else [np.append(goal, session.surface(goal[:1], goal[1:]))])

    def show_status(self) -> None:
        """Show the active task, and a fall, a jump on its way or a recording."""
        session = self.session
        words = [session.tasks[session.skill].name]
        words += [f"**fell: {session.fallen.replace('_', ' ')}**"] if session.fallen else []
        words += ["to the jump"] if session.jump and session.skill == 0 else []
        words += [f"recording {self.take.frames * self.take.step_dt:.0f} s"] if self.take else []
        if (text := " · ".join(words)) != self.status.content:
            self.status.content = text

    def finish_take(self) -> None:
        """End the recording, write its files in the background, and show their folder to all visitors."""
        if self.take is not None:
            self.take.finish(self.notify)
            self.take = None

    def notify(self, title: str, text: str) -> None:
        """Show a notification to all visitors."""
        for client in list(self.visitors.values()):
            client.add_notification(title, text, auto_close_seconds=8.0)


class Controls:
    """Controls of the driver, in that visitor's own interface."""

    def __init__(self, page: Page, client: ClientHandle) -> None:
        """Add all controls that fit the session's tasks."""
        self.page = page
        self.session = page.session
        self.gui = client.gui
        self.sliders = np.zeros(3)
        self.height = 0.0  # [m] Commanded height of jumps up
        if len(page.session.tasks) > 1:
            self.gui.add_markdown(HELP, order=0.0)
        tabs = self.gui.add_tab_group(order=2.0)
        with tabs.add_tab("Drive"):
            self._add_commands()
            self._add_clock()
        with tabs.add_tab("Robot"):
            self._add_values()
            self._add_push()
        if "walk" in self.session.kinds():
            self._add_keys()
        if "jump there" in self.session.kinds():
            client.scene.on_click()(lambda event: self.page.post(self._click, event.ray_origin, event.ray_direction))

    def _add_commands(self) -> None:
        """Add sliders and buttons of the commands that the tasks take."""
        kinds = self.session.kinds()
        task = self.session.tasks[0]
        if "walk" in kinds:
            for bound, label in zip(trained_bounds(task), task.command.labels, strict=False):
                slider = self.gui.add_slider(label, bound.low, bound.high, 0.05, 0.0)
                slider.on_update(lambda event, i=bound.index: self.page.post(self._slide, i, event.target.value))
        if "jump up" in kinds:
            bound = trained_bounds(self.session.tasks[kinds["jump up"]])[0]
            low, self.height, high = np.round([bound.low, 0.5 * (bound.low + bound.high), bound.high], 2).tolist()
            slider = self.gui.add_slider("jump height [m]", low, high, 0.01, self.height)
            slider.on_update(lambda event: setattr(self, "height", event.target.value))
            self._button("T jump up", self._jump_up)
        if not kinds:
            self._add_other_command()

    def _add_other_command(self) -> None:
        """Add a number for each value of the command of a task that neither walks nor jumps."""
        labels = self.session.tasks[0].command.labels or tuple(f"value {i + 1}" for i in range(4))
        numbers = [self.gui.add_number(label, float(label == "quaternion w [1]"), step=0.05) for label in labels]
        self._button("C command", lambda: self.session.env.command([number.value for number in numbers]))

    def _add_clock(self) -> None:
        """Add controls of time, episode, ground and recording."""
        pace = self.gui.add_slider("speed [1]", 0.1, 1.0, 0.05, self.page.speed)
        pace.on_update(lambda event: setattr(self.page, "speed", event.target.value))
        ground = self.gui.add_dropdown("ground", GROUNDS, initial_value=self.session.ground)
        ground.on_update(lambda event: self.page.post(self._change_ground, event.target.value))
        actions = {"P pause": self._pause, "N step": self._single_step, "R reset": self.session.reset}
        buttons = self.gui.add_button_group("time", list(actions))
        buttons.on_click(lambda event: self.page.post(actions[event.target.value]))
        for label, action in actions.items():
            self._shortcut(label, action)
        self._button("V record, stop", self._record)

    def _add_values(self) -> None:
        """Add sliders of physical values, which act at once."""
        for name, most in MAX_VALUES.items():
            now = (self.session.nominal | self.session.values)[name]
            slider = self.gui.add_slider(name, 0.0, max(most, round(now, 2)), 0.01 * most, round(now, 2))
            slider.on_update(lambda event, name=name: self.page.post(self.session.set_value, name, event.target.value))

    def _add_push(self) -> None:
        """Add a button that pushes the base, and sliders of force and direction."""
        force = self.gui.add_slider("push [N]", 0.0, 200.0, 5.0, 60.0)
        direction = self.gui.add_slider("direction [deg]", -180.0, 180.0, 15.0, 90.0, hint="0: ahead, 90: to the left")
        self._button("B push", lambda: self.session.push(force.value, direction.value))

    def _add_keys(self) -> None:
        """Add the script that watches keys and gamepad, and the text field through which it reports them."""
        field = self.gui.add_text(KEY_LABEL, "", order=3.0)
        field.on_update(lambda event: self.page.post(self._hold, event.target.value))
        self.gui.add_html(f'<img style="display: none" src="data:," onerror="{html.escape(script())}">', order=4.0)

    def _button(self, label: str, action: Callable[[], object]) -> None:
        """Add a button that runs an action before the next step; a label `X words` has the shortcut X."""
        self.gui.add_button(label).on_click(lambda event: self.page.post(action))
        self._shortcut(label, action)

    def _shortcut(self, label: str, action: Callable[[], object]) -> None:
        """Add the keyboard shortcut of a label `X words`, which viser's command palette (Ctrl+K) lists too."""
        key: Any = label[0]
        self.gui.add_command(label[2:], hotkey=key).on_trigger(lambda event: self.page.post(action))

    # ------------------------------------------------------------------ actions, in the thread of the loop

    def _slide(self, component: int, value: float) -> None:
        """Command the velocity of the sliders."""
        self.sliders[component] = value
        self.session.velocity = self.sliders.copy()

    def _hold(self, text: str) -> None:
        """Command the velocity of held keys or a gamepad, such as `i l` or `pad 0.5 0.0 0.2`; if none, the sliders'."""
        first, *rest = text.split() or [""]
        direction = np.zeros(3)
        if first == "pad":
            direction = np.array(rest[:3], dtype=float)
            if rest[3:] and "jump up" in self.session.kinds():
                self._jump_up()
        else:
            for component, sign in (KEYS[key] for key in text.split() if key in KEYS):
                direction[component] += sign
        if direction.any():
            self.session.cancel_jump()
        self.session.velocity = direction * KEY_SPEEDS if direction.any() else self.sliders.copy()

    def _click(self, origin: tuple[float, ...], direction: tuple[float, ...]) -> None:
        """Jump to the clicked point of the ground."""
        goal = self.session.ground_point(np.array(origin) + self.page.scene.center, np.array(direction))
        if goal is not None:
            self.session.jump_to(goal)

    def _jump_up(self) -> None:
        self.session.jump_up(self.height)

    def _pause(self) -> None:
        self.page.paused = not self.page.paused

    def _single_step(self) -> None:
        self.page.paused = True
        self.page.advance()

    def _record(self) -> None:
        page = self.page
        if page.take is None:
            page.take = Take(page.server, self.session, page.model, page.folder)
        else:
            page.finish_take()

    def _change_ground(self, ground: str) -> None:
        self.page.finish_take()
        self.session.build(ground)
        self.page.draw_ground()


@cache
def script() -> str:
    """Return the script that runs in the driver's page and reports keys and gamepad."""
    text = files("jumper_warp.live").joinpath("keys.js").read_text()
    lines = [line for line in text.splitlines() if not line.strip().startswith("//")]
    return "\n".join(lines).replace("LABEL", f"'{KEY_LABEL}'").replace("KEYS", f"'{''.join(KEYS)}'")

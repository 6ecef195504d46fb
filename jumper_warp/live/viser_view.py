"""Live view of watched worlds as a page in the browser, served by viser: scene, stacked reward terms, curves."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import numpy as np

from jumper_warp.live.curves import curves_of
from jumper_warp.live.scene import RobotScene
from jumper_warp.viz.style import SERIES_COLORS, css
from jumper_warp.viz.viser import ROOT, ViserScene, open_server

PORT = 8081  # the next free one is used if it is taken
ABOVE = np.array([0.0, 0.0, 0.3])  # [m] from a robot's base to its name
EYE = (3.2, -1.0, 1.9)  # [m] camera of a new visitor
COLORS = [css(color) for color in SERIES_COLORS]


class ViserView:
    """View of the robots of several slots; every visitor of the page sees the same."""

    rate = 20.0  # [1/s] updates of the robots

    def __init__(self, scene: RobotScene, names: Sequence[str], terms: Sequence[str]) -> None:
        """Start the server, on the loopback address only; names: of the slots; terms: names of the reward terms.

        Raises InputError: viser is not installed.
        """
        self._server: Any = open_server(PORT)
        self.url = self.page = f"http://127.0.0.1:{self._server.get_port()}"
        self._names = list(names)
        self._terms = list(terms)
        self._scene = ViserScene(self._server.scene, scene.shapes, robots=len(names))
        self._labels = [self._server.scene.add_label(f"{ROOT}/name_{i}", name) for i, name in enumerate(names)]
        self._server.initial_camera.position = EYE
        self._status = self._server.gui.add_markdown("")
        self._tabs = self._server.gui.add_tab_group()
        with self._tabs.add_tab("reward terms"):
            self._bars = self._server.gui.add_html("")
        self._curves: dict[str, dict[str, list[tuple[float, float]]]] = {}
        self._plots: dict[str, Any] = {}

    def show(self, times: np.ndarray, poses: np.ndarray, goals: np.ndarray) -> None:
        """Show the robots' last poses; arguments as of `RerunView.show`."""
        with self._server.atomic():
            self._scene.update(poses[-1])
            for label, pose in zip(self._labels, poses[-1], strict=True):
                label.position = pose[0, :3] + ABOVE
            self._scene.show_goals([goal for goal in goals if np.isfinite(goal).all()])
        self._server.flush()

    def show_rewards(self, when: float, sums: np.ndarray) -> None:
        """Show stacked bars of the terms' sums over the episodes, (slots, terms): positive ones above negative ones."""
        most = max(float(np.maximum(sums, 0.0).sum(1).max()), float(np.maximum(-sums, 0.0).sum(1).max()), 1.0e-6)
        rows = []
        for name, values in zip(self._names, sums, strict=True):
            rows.append(f"{html.escape(name)} <b>{values.sum():.3g}</b>")
            rows += [_bar(np.maximum(sign * values, 0.0) / most) for sign in (1.0, -1.0)]
        for i, term in enumerate(self._terms):
            rows.append(f'<span style="color:{COLORS[i % len(COLORS)]}">&#9632;</span> {html.escape(term)}')
        self._bars.content = f'<div style="font-size:12px;padding:0 8px">{"<br>".join(rows)}</div>'

    def show_curves(self, lines: Sequence[dict[str, Any]], label: str = "") -> None:
        """Append lines of a metrics file to the curves; label: of the seed, empty for a single one."""
        new = curves_of(lines, label)
        for (group, name), points in new.items():
            self._curves.setdefault(group, {}).setdefault(name, []).extend(points)
        for group in dict.fromkeys(group for group, _ in new):
            curves = self._curves[group]
            times = np.unique([when for points in curves.values() for when, _ in points])
            data = (times, *(np.interp(times, *np.array(points).T) for points in curves.values()))
            if group in self._plots and len(self._plots[group].data) == len(data):
                self._plots[group].data = data
                continue
            if group in self._plots:
                self._plots.pop(group).remove()
            series = [{"label": name, "stroke": COLORS[i % len(COLORS)]} for i, name in enumerate(curves)]
            self._plots[group] = self._server.gui.add_uplot(
                data, ({"label": "time [s]"}, *series), title=group, height=240, scales={"x": {"time": False}}
            )

    def show_status(self, text: str) -> None:
        """Show a text in Markdown."""
        self._status.content = text

    def close(self) -> None:
        """End the server."""
        self._server.stop()


def _bar(widths: np.ndarray) -> str:
    """Return a stacked horizontal bar as HTML; widths: of its parts, as fractions of the largest bar, (n,)."""
    part = '<div style="height:9px;width:{:.1f}%;background:{}"></div>'
    parts = [part.format(100.0 * width, COLORS[i % len(COLORS)]) for i, width in enumerate(widths) if width > 0.002]
    return f'<div style="display:flex">{"".join(parts)}</div>'

"""Plots of a driven robot over the last seconds, and bars of its reward terms, in the viewer of the browser."""

from __future__ import annotations

import html
from collections import deque
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from jumper_warp.robot.description import LEGS
from jumper_warp.viz.style import ACTUAL_COLOR, COMMAND_COLOR, LEG_COLORS, css

if TYPE_CHECKING:
    from viser import ViserServer

    from jumper_warp.live.session import Session

SECONDS = 5.0  # [s] Time axis of the plots
WIDTH = 300  # [px] Width of the panel of plots
AXIS = 56  # [px] Width of the values beside a plot, such as -0.002
TORQUE = "torque over limit"
PLOTS = {
    "Motion": {"height": ("height of the base [m]", (0.0, 1.0)), "velocity": ("velocity [m/s], [rad/s]", (-1.0, 1.0))},
    "Forces": {"paw force": ("paw forces [N]", (0.0, 100.0)), TORQUE: ("largest torque over limit [1]", (0.0, 1.0))},
}
"""Heading and least range of each plot by tab and group of series."""
CURVE_COLORS = LEG_COLORS | {
    "commanded": COMMAND_COLOR, "ahead": LEG_COLORS["FL"], "to the left": LEG_COLORS["FR"],
    "yaw rate": LEG_COLORS["BL"],
}  # fmt: skip


class Plots:
    """Plots of the last seconds and bars of the reward terms, in a panel of their own that every visitor sees."""

    def __init__(self, server: ViserServer, session: Session, every: int) -> None:
        """Add the panel; every: policy steps between two samples."""
        self.interval = every * session.env.step_dt
        count = round(SECONDS / self.interval)
        self.samples = deque(count * [session.series()], maxlen=count)
        self.times = deque(self.interval * np.arange(1 - count, 1), maxlen=count)  # viser scales the axis by the first
        self.turn = 0
        self.plots = {}
        panel = server.gui.add_panel()
        for title, groups in PLOTS.items():
            with panel.add_tab(title):
                for group, (heading, least) in groups.items():
                    curves = self.curves(group)
                    low, high = ({"pad": 0.05, "soft": end, "mode": 1} for end in least)
                    self.plots[group] = server.gui.add_uplot(
                        tuple(curves.values()), series_of(curves), title=heading, height=230,
                        scales={"x": {"time": False}, "y": {"range": {"min": low, "max": high}}},
                        axes=({}, {"size": AXIS}), legend={"live": False},
                    )  # fmt: skip
        with panel.add_tab("Reward"):
            self.bars = server.gui.add_html("")
        panel.dock_left()
        panel.set_width(WIDTH)

    def sample(self, session: Session) -> None:
        """Append the session's current values."""
        self.samples.append(session.series())
        self.times.append(self.times[-1] + self.interval)

    def redraw(self) -> None:
        """Send the newest values of one plot or of the bars, in turn."""
        self.turn = (self.turn + 1) % (len(self.plots) + 1)
        if self.turn == len(self.plots):
            self.bars.content = bars_of(self.samples[-1])
        else:
            group = list(self.plots)[self.turn]
            self.plots[group].data = tuple(self.curves(group).values())

    def curves(self, group: str) -> dict[str, np.ndarray]:
        """Return the time axis [s] and a plot's curves by label, (samples,) each; of torques each leg's largest one."""
        names = [name for name in self.samples[-1] if name.startswith(group)]
        labels = [name.partition("/")[2].partition(" [")[0] for name in names]
        values = np.array([[sample[name] for name in names] for sample in self.samples])
        if group == TORQUE:
            values = np.stack(
                [np.abs(values[:, [label[:2] == leg for label in labels]]).max(axis=1) for leg in LEGS], 1
            )
            labels = list(LEGS)
        return {"time [s]": np.array(self.times)} | dict(zip(labels, values.T.copy(), strict=True))


def series_of(labels: Iterable[str]) -> tuple[Any, ...]:
    """Return the settings of a plot's curves by label, the time axis first.

    Commanded values are dots, which are absent where they are undefined, and do not change the range of the plot.
    """
    series: list[Any] = [{"label": "time [s]"}]
    for label in list(labels)[1:]:
        name, _, commanded = label.partition(", ")
        color = css(CURVE_COLORS.get(name, CURVE_COLORS["FL"]))
        dots = {"auto": False, "width": 0, "points": {"show": True, "size": 3, "fill": color}}
        style = dots if commanded or label == "commanded" else {"width": 1.5}
        series.append({"label": label, "stroke": color, **style})
    return tuple(series)


def bars_of(values: Mapping[str, float]) -> str:
    """Return bars of the active task's reward terms in the last step as HTML; values: of `Session.series`."""
    prefix = "reward of "
    terms = {name: value for name, value in values.items() if name.startswith(prefix) and np.isfinite(value)}
    most = max([1.0e-9, *map(abs, terms.values())])
    task = next(iter(terms), "").removeprefix(prefix).partition("/")[0]
    rows = [f"<b>{html.escape(task)}</b>, value of each term in this step"]
    for name, value in terms.items():
        label = html.escape(name.partition("/")[2].partition(" [")[0])
        color = css(ACTUAL_COLOR if value > 0.0 else COMMAND_COLOR)
        bar = f'<div style="height:4px;width:{100.0 * abs(value) / most:.0f}%;background:{color}"></div>'
        rows.append(f'<div style="display:flex;justify-content:space-between">{label}<i>{value:.4f}</i></div>{bar}')
    return f'<div style="font-size:12px;padding:0 8px">{"".join(rows)}</div>'

"""Plots of a driven robot over the last seconds, and bars of its reward terms, in the viewer of the browser."""

from __future__ import annotations

import html
from collections import deque
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from jumper_warp.robot.description import LEGS
from jumper_warp.viz.style import COMMAND_COLOR, LEG_COLORS

if TYPE_CHECKING:
    from viser import ViserServer

    from jumper_warp.live.session import Session

SECONDS = 5.0  # [s] Time axis of the plots
WIDTH = 300  # [px] Width of the panel of plots
AXIS = 56  # [px] Width of the values beside a plot, such as -0.002
TORQUE = "torque over limit"
PLOTS = {
    "Motion": {"height": "height of the base [m]", "velocity": "velocity [m/s], [rad/s]"},
    "Forces": {"paw force": "paw forces [N]", TORQUE: "largest torque over limit [1]"},
}
"""Heading of each plot by tab and group of series."""
CURVE_COLORS = LEG_COLORS | {
    "commanded": COMMAND_COLOR, "ahead": LEG_COLORS["FL"], "to the left": LEG_COLORS["FR"],
    "yaw rate": LEG_COLORS["BL"],
}  # fmt: skip


class Plots:
    """Plots of the last seconds and bars of the reward terms, in a panel of their own that every visitor sees."""

    def __init__(self, server: ViserServer, session: Session, every: int) -> None:
        """Add the panel; every: policy steps between two samples."""
        self.interval = every * session.env.step_dt
        self.samples: deque[dict[str, float]] = deque(maxlen=round(SECONDS / self.interval))
        self.times: deque[float] = deque(maxlen=self.samples.maxlen)
        self.sample(session)
        self.turn = 0
        self.plots = {}
        panel = server.gui.add_panel()
        for title, groups in PLOTS.items():
            with panel.add_tab(title):
                for group, heading in groups.items():
                    curves = self.curves(group)
                    self.plots[group] = server.gui.add_uplot(
                        tuple(curves.values()), series_of(curves), title=heading, height=230,
                        scales={"x": {"time": False}}, axes=({}, {"size": AXIS}), legend={"live": False},
                    )  # fmt: skip
        with panel.add_tab("Reward"):
            self.bars = server.gui.add_html("")
        panel.dock_left()
        panel.set_width(WIDTH)

    def sample(self, session: Session) -> None:
        """Append the session's current values."""
        self.samples.append(session.series())
        self.times.append(self.times[-1] + self.interval if self.times else 0.0)

    def redraw(self) -> None:
        """Send the newest values of one plot or of the bars, in turn."""
        self.turn = (self.turn + 1) % (len(self.plots) + 1)
        if self.turn == len(self.plots):
            self.bars.content = bars_of(self.samples[-1])
        else:
            group = list(self.plots)[self.turn]
            self.plots[group].data = tuple(self.curves(group).values())

    def curves(self, group: str) -> dict[str, np.ndarray]:
        """Return the time axis [s] and the curves of a plot by label, (samples,) each; of torques each leg's largest.

        An undefined commanded value is drawn on the actual one, the curve before it.
        """
        names = [name for name in self.samples[-1] if name.startswith(group)]
        labels = [name.partition("/")[2].partition(" [")[0] for name in names]
        values = np.array([[sample[name] for name in names] for sample in self.samples])
        if group == TORQUE:
            values = np.stack(
                [np.abs(values[:, [label[:2] == leg for label in labels]]).max(axis=1) for leg in LEGS], 1
            )
            labels = list(LEGS)
        for i in range(1, len(labels)):
            values[:, i] = np.where(np.isfinite(values[:, i]), values[:, i], values[:, i - 1])
        return {"time [s]": np.array(self.times)} | dict(zip(labels, values.T.copy(), strict=True))


def series_of(labels: Iterable[str]) -> tuple[Any, ...]:
    """Return the settings of a plot's curves by label, the time axis first; commanded values are dashed."""
    series: list[Any] = []
    for label in labels:
        name, _, commanded = label.partition(", ")
        rgb = ",".join(str(round(255 * part)) for part in CURVE_COLORS.get(name, CURVE_COLORS["FL"]))
        dash = [5, 4] if commanded or label == "commanded" else []
        series.append({"label": label, "stroke": f"rgb({rgb})", "width": 1.5, "dash": dash})
    return ({"label": "time [s]"}, *series[1:])


def bars_of(values: Mapping[str, float]) -> str:
    """Return bars of the active task's reward terms in the last step as HTML; values: of `Session.series`."""
    prefix = "reward of "
    terms = {name: value for name, value in values.items() if name.startswith(prefix) and np.isfinite(value)}
    most = max([1.0e-9, *map(abs, terms.values())])
    task = next(iter(terms), "").removeprefix(prefix).partition("/")[0]
    rows = [f"<b>{html.escape(task)}</b>, value of each term in this step"]
    for name, value in terms.items():
        label = html.escape(name.partition("/")[2].partition(" [")[0])
        color = "#0072b2" if value > 0.0 else "#d55e00"
        bar = f'<div style="height:4px;width:{100.0 * abs(value) / most:.0f}%;background:{color}"></div>'
        rows.append(f'<div style="display:flex;justify-content:space-between">{label}<i>{value:.4f}</i></div>{bar}')
    return f'<div style="font-size:12px;padding:0 8px">{"".join(rows)}</div>'

"""Motions side by side: recordings that begin at the same time in one recording, and its picture."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from jumper_warp.utils.files import write_atomically
from jumper_warp.viz.picture import write_picture
from jumper_warp.viz.recording import Recording

SPACING = 1.2  # [m] Least distance between robots
OMITTED = re.compile(r"(peak paw force|torque|angle|rate|action|observation .*|reward)/")
"""Series of one robot that are omitted, since each of them fills a plot."""


def side_by_side(recordings: Mapping[str, Recording]) -> Recording:
    """Return a recording of the first robot of each recording by label; a shorter motion ends in its last pose.

    Series of the base are overlaid.
    """
    parts = list(recordings.values())
    times = max((each.times for each in parts), key=len)
    count = len(parts)
    shapes = [shape for shape in parts[0].shapes if shape.body < 0]
    bodies: list[str] = []
    series: dict[str, np.ndarray] = {}
    states: dict[str, list[str]] = {}
    frames: list[dict[str, np.ndarray]] = []
    goals = np.full((count, max(each.goals.shape[1] for each in parts), 3), np.nan, np.float32)
    heights = np.full(count, np.nan, np.float32)
    for rank, (label, each) in enumerate(recordings.items()):
        held = np.minimum(np.arange(len(times)), len(each.times) - 1)
        own = {body: len(bodies) + i for i, body in enumerate(each.body_indices(0))}
        shapes += [replace(shape, body=own[shape.body]) for shape in each.shapes if shape.body in own]
        bodies += [f"world_{rank}/{each.bodies[body].partition('/')[2]}" for body in own]
        if len(each.goals):
            goals[rank, : each.goals.shape[1]] = each.goals[0]
        if len(each.heights):
            heights[rank] = each.heights[0]
        commands = each.commands[held, 0] if len(each.commands) else np.full((len(times), 3), np.nan, np.float32)
        frames.append({
            "poses": each.body_poses(0)[held], "points": each.contact_points[held, 0],
            "forces": each.contact_forces[held, 0], "commands": commands,
        })  # fmt: skip
        series |= {name: values[held] for name, values in _labelled(each, label).items()}
        ends = f"/{each.label(0)}"
        states |= {
            name.replace(ends, f"/{label}"): [words[i] for i in held]
            for name, words in each.states.items() if name.endswith(ends)
        }  # fmt: skip
    points, forces, commands = (
        np.stack([each[name] for each in frames], 1) for name in ("points", "forces", "commands")
    )
    return Recording(
        times, tuple(range(count)), tuple(bodies), np.concatenate([each["poses"] for each in frames], axis=1), series,
        points, forces, max(SPACING, *(each.spacing for each in parts)), tuple(shapes),
        {"title": " and ".join(recordings)}, tuple(recordings), states, goals, heights,
        commands if np.isfinite(commands).any() else commands[:0, :0],
    )  # fmt: skip


def _labelled(recording: Recording, label: str) -> dict[str, np.ndarray]:
    """Return the series of a recording's first robot with a label, `group/quantity, label [unit]`.

    A series without its robot's name is in a group of its own.
    """
    name_of_robot = f", {recording.label(0)} ["
    series = {}
    for name, values in recording.series.items():
        group, quantity = name.split("/", 1)
        if name_of_robot in name:
            series[name.replace(name_of_robot, f", {label} [")] = values
        elif not OMITTED.match(name) and ", " not in quantity:
            series[f"{group} {quantity.partition(' [')[0]}/{quantity.replace(' [', f', {label} [')}"] = values
    return series


def write_pictures(recording: Recording, path: Path, **options: Any) -> Path:
    """Write the composite pictures of all robots of a recording, one below the other; options: of `write_picture`."""
    images = [
        np.array(Image.open(write_picture(recording, path, rank=rank, title=recording.label(rank), **options)))
        for rank in range(len(recording.worlds))
    ]
    data = io.BytesIO()
    Image.fromarray(np.concatenate(images)).save(data, "png")
    write_atomically(path, data.getvalue())
    return path

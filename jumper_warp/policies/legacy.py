"""Configurations of version 1, which had one environment for jumps only, as tasks of today."""

from __future__ import annotations

import inspect
import math
from types import ModuleType
from typing import Any, get_type_hints

import warp as wp

from jumper_warp.kernels.jump import rewards, terminations
from jumper_warp.kernels.mdp import rewards as mdp_rewards
from jumper_warp.kernels.mdp import terminations as mdp_terminations
from jumper_warp.tasks.jump.horizontal import horizontal_jump, omnidirectional_jump
from jumper_warp.tasks.jump.vertical import vertical_jump
from jumper_warp.tasks.saving import MAX_ENTRIES, VERSION, TaskError, name_of, plain, shown
from jumper_warp.tasks.terms import RewardTerm, TerminationTerm

PLACE = {"observe": "observe_horizontal", "columns": ["goal_x", "goal_y", "height"], "error": "landing_error"}
HEIGHT = {"observe": "observe_vertical", "columns": ["wanted_height", "jump_command", "height"],
          "error": "height_error"}  # fmt: skip
TASKS = {
    "vertical-jump": (vertical_jump, HEIGHT),
    "horizontal-jump": (horizontal_jump, PLACE),
    "omnidirectional-jump": (omnidirectional_jump, PLACE),
}
"""All tasks that there were, with what each of them observed."""
REQUIRED = ("name", "terms", "rules", "levels", "motors", "command_filter", "action_scale")
DEFAULTS: dict[str, Any] = {
    "reset": {}, "ground": {}, "randomization": {}, "noise": {}, "ppo": {}, "takeoff_speed": 0.75,
    "contact_force": 0.1, "near": 0.10, "games": 5,
}  # fmt: skip
"""Of the settings that a configuration could lack; those of PPO are not the task's any more."""
PUSHES = {"push_interval": None, "push_share": 1.0}
"""Timing of pushes then: one wrench for the whole episode."""
NOISE = {"lin_vel": ("lin_vel", 1.0), "ang_vel": ("ang_vel", 1.0), "gravity": ("gravity", 1.0),
         "angle": ("angle", math.pi / 180.0), "rate": ("rate", math.pi / 180.0), "goal": ("position", 1.0),
         "height": ("position", 1.0)}  # fmt: skip
"""Observation terms: the noise that they had, and its unit."""


def upgraded(saved: dict[str, Any]) -> dict[str, Any]:
    """Return a task of version 1 as JSON of today's version; settings that it lacks are what they were then.

    Raises:
        TaskError: It is not a jump of version 1.
    """
    name = saved.get("name")
    if not isinstance(name, str) or name not in TASKS:
        raise TaskError(f"unknown task {shown(name)}, version 1 had {', '.join(TASKS)}")
    make, observed = TASKS[name]
    missing = [key for key in REQUIRED if key not in saved]
    unknown = [key for key in saved if key not in (*REQUIRED, *DEFAULTS, *observed)]
    if missing or unknown:
        raise TaskError(f"task: {'no ' if missing else 'unknown setting '}{(missing or unknown)[0]!r:.60}")
    for key, expected in observed.items():
        if saved.get(key, expected) != expected:
            raise TaskError(f"task.{key}: this version has {expected}, got {shown(saved[key])}")
    try:
        return {"version": VERSION, **_content(plain(make()), DEFAULTS | saved)}
    except (KeyError, TypeError, AttributeError, ArithmeticError) as error:
        raise TaskError(f"no task of version 1 ({type(error).__name__}: {error!s:.100})") from error


def _content(today: dict[str, Any], saved: dict[str, Any]) -> dict[str, Any]:
    """Return today's JSON of the same task with the saved settings."""
    today |= {name: saved[name] for name in ("motors", "command_filter", "action_scale", "contact_force")}
    today["policy"] = [row | {"history": 1} for row in today["policy"]]
    today["advance"]["takeoff_speed"] = saved["takeoff_speed"]
    today["curriculum"] |= {"tolerance": saved["near"], "promote_after": saved["games"]}
    today["rewards"] = _rows(saved, "terms", (rewards, mdp_rewards))
    today["terminations"] = _rows(saved, "rules", (terminations, mdp_terminations))
    today["randomization"] = {**PUSHES, **saved["randomization"], "redraw": "startup"}
    states = {**saved["reset"]}
    again = states.pop("jump_again", 0.0)
    today["reset"]["settings"] = {
        "type": today["reset"]["settings"]["type"], **states, "ground": saved["ground"],
    }  # fmt: skip
    kind = today["levels"][0]["type"]
    today["levels"] = [
        {"type": kind, **level, "jump_again": again if i else 0.0} for i, level in enumerate(_list(saved, "levels"))
    ]
    noise = {**saved["noise"]}
    unknown = [key for key in noise if key not in {name for name, _ in NOISE.values()}]
    if unknown:
        raise TaskError(f"task.noise: unknown setting {unknown[0]!r:.60}")
    for term in today["policy"]:
        name, unit = NOISE.get(term["name"], ("", 1.0))
        if name in noise:
            term["noise"] = unit * noise[name]
    return today


def _list(saved: dict[str, Any], section: str) -> list[Any]:
    rows = saved[section]
    if not isinstance(rows, list) or len(rows) > MAX_ENTRIES or not all(isinstance(row, dict) for row in rows):
        raise TaskError(f"task.{section}: expected a list of settings by name, at most {MAX_ENTRIES}")
    return rows


def _rows(saved: dict[str, Any], section: str, shelves: tuple[ModuleType, ...]) -> list[dict[str, Any]]:
    """Return rewards or terminations; numbers that had places then have names now."""
    made, kind = [], RewardTerm if section == "terms" else TerminationTerm
    for i, row in enumerate(_list(saved, section)):
        where, name, params = f"task.{section}[{i}]", row.get("func"), row.get("params")
        found = [vars(shelf).get(name) for shelf in shelves] if isinstance(name, str) else []
        found = [func for func in found if isinstance(func, wp.Function)]
        func = next((func for func in found if get_type_hints(func.func).get("return") in kind.returns), None)
        if func is None:
            raise TaskError(f"{where}: this version has no {shown(name)}")
        extra = [key for key in row if key not in ("func", "params", "weight", "once", "success")]
        if extra:
            raise TaskError(f"{where}: unknown setting {extra[0]!r:.60}")
        names = list(inspect.signature(func.func).parameters)[2:]
        if not isinstance(params, list) or len(params) != len(names):
            raise TaskError(f"{where}: {name} has {len(names)} numbers by place")
        term = {"type": name_of(kind), "func": name_of(func), "name": name}
        term |= dict(zip(names, params, strict=True))
        if section == "terms":
            term |= {"weight": row["weight"], "once": row.get("once", False)}
        else:
            term |= {"time_out": row.get("success", False), "success": name == "success"}
        made.append(term)
    return made

"""Configurations of version 1, which had one environment for jumps only, as tasks of today."""

from __future__ import annotations

import inspect
from typing import Any

from jumper_warp.registry import make_task
from jumper_warp.tasks.saving import TaskError, name_of, plain
from kernels.jump import rewards, terminations
from kernels.mdp import rewards as mdp_rewards
from kernels.mdp import terminations as mdp_terminations

NOISE = {"lin_vel": "lin_vel", "ang_vel": "ang_vel", "gravity": "gravity", "angle": "angle", "rate": "rate",
         "goal": "position", "height": "position"}  # fmt: skip
"""Observation terms by the noise that they had."""
DEGREES = ("angle", "rate")
"""Noise that was saved in degrees."""
FROM_TASK = ("motors", "command_filter", "action_scale", "contact_force")
"""Fields that are as they were."""


def upgraded(saved: Any) -> dict[str, Any]:
    """Return a task of version 1 as JSON of today's version; settings that it lacks are what they were then.

    Raises:
        TaskError: It is not a jump of version 1.
    """
    try:
        task = make_task(saved["name"])
        content: dict[str, Any] = plain(task)
        content |= {name: saved[name] for name in FROM_TASK}
        content["advance"]["takeoff_speed"] = saved["takeoff_speed"]
        content["curriculum"] |= {"tolerance": saved["near"], "promote_after": saved["games"]}
        content["rewards"] = [_row(row, "reward", (rewards, mdp_rewards)) for row in saved["terms"]]
        content["terminations"] = [_row(row, "termination", (terminations, mdp_terminations)) for row in saved["rules"]]
        kind = content["randomization"]["type"]
        content["randomization"] = {"type": kind, **saved["randomization"], "redraw": "startup"}
        settings = content["reset"]["settings"]
        level_ground = {"type": settings["ground"]["type"]}
        states = {name: value for name, value in saved["reset"].items() if name != "jump_again"}
        settings = {"type": settings["type"], **states, "ground": level_ground | saved.get("ground", {})}
        content["reset"]["settings"] = settings
        kind, again = content["levels"][0]["type"], saved["reset"]["jump_again"]
        content["levels"] = [
            {"type": kind, **level, "jump_again": again if i else 0.0} for i, level in enumerate(saved["levels"])
        ]
        for term in content["policy"]:
            if term["name"] in NOISE:
                noise = NOISE[term["name"]]
                scale = 0.017453292519943295 if noise in DEGREES else 1.0
                term["noise"] = scale * saved["noise"][noise]
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise TaskError(f"no task of version 1 ({type(error).__name__}: {error})") from error
    except ValueError as error:
        raise TaskError(str(error)) from error
    return {"version": 2, **content}


def _row(saved: dict[str, Any], what: str, shelves: tuple) -> dict[str, Any]:
    """Return a reward or termination; numbers that had places then have names now."""
    func = next((getattr(shelf, saved["func"]) for shelf in shelves if hasattr(shelf, saved["func"])), None)
    if func is None:
        raise TaskError(f"this version has no {what} {saved['func']!r:.60}")
    names = list(inspect.signature(func.func).parameters)[2:]
    if len(saved["params"]) != len(names):
        raise TaskError(f"{what} {saved['func']} has {len(names)} numbers, the configuration {len(saved['params'])}")
    kind = "RewardTerm" if what == "reward" else "TerminationTerm"
    row = {"type": f"jumper_warp.tasks.terms:{kind}", "func": name_of(func), "name": saved["func"]}
    row |= dict(zip(names, saved["params"], strict=True))
    if what == "reward":
        return row | {"weight": saved["weight"], "once": saved["once"]}
    return row | {"time_out": saved["success"], "success": saved["func"] == "success"}

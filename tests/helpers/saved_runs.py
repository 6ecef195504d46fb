"""Folders of runs with given logs, for tests that read them."""

import json

from jumper_warp.recipe import Recipe
from jumper_warp.rl.metrics_file import METRICS_FILE
from jumper_warp.rl.run_folder import CONFIG


def save_run(root, name, seed, success, *, weight=None, rewards=None, start=0):
    """Write the run `name` of a seed with logged successes, and return its folder; rewards: last terms by name."""
    recipe = Recipe.of("vertical-jump").to_json()
    recipe["train"] |= {"seed": seed, "run_name": name, "num_envs": 8}
    if weight is not None:
        recipe["env"]["task"]["rewards"][0]["weight"] = weight
    folder = root / "vertical-jump" / f"2026-01-01_00-00-{start:02d}_00000{seed}+0000_{name}"
    folder.mkdir(parents=True)
    (folder / CONFIG).write_text(json.dumps(recipe))
    rows = [
        {"iteration": 10 * (i + 1), "Perf/elapsed_s": 2.0 * (i + 1), "Metrics/success": value}
        | {f"Episode_Reward/{term}": reward for term, reward in (rewards or {}).items()}
        for i, value in enumerate(success)
    ]
    (folder / METRICS_FILE).write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder

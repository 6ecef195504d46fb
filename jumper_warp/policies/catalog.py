"""Look-up of policies by name or folder, and summaries of their metrics, without PyTorch."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jumper_warp.policies.manifest import CONFIG, MANIFEST, ONNX, README, parse_object, read_files
from jumper_warp.policies.spec import PolicyError, PolicyInterface
from jumper_warp.registry import task_name
from jumper_warp.rl.metrics_file import METRICS_FILE
from jumper_warp.rl.run_names import newest
from jumper_warp.utils.assets import POLICIES, policy_tasks
from jumper_warp.utils.errors import InputError, suggestion
from jumper_warp.utils.files import read_file

METRICS = "metrics.json"
PICTURE = "picture.webp"
SUCCESSES = ("success_rate", "settled_without_collision_rate")
"""Keys of the success rate; a policy's is the first one that its metrics have."""
ERRORS = (
    "apex_error_abs_mean_m", "goal_distance_at_rest_mean_m", "settled_rmse_vx_m_s", "error_at_end_mean_deg",
)  # fmt: skip
"""Keys of the error; a policy's is the first one that its metrics have."""


@dataclass(frozen=True)
class PolicySummary:
    """Description and metrics of a policy, from the files in its folder."""

    name: str  # Name of the folder
    folder: Path
    task: str
    about: str  # First paragraph of README.md, without markup
    size_bytes: int  # Size of policy.onnx
    rows: list[dict[str, Any]]
    """Metrics by condition, as in metrics.json: condition, seed, conditions, metrics; empty: not evaluated."""

    @property
    def metrics(self) -> dict[str, Any]:
        """Metrics of the policy's first test condition, as in metrics.json; may be empty.

        In the project's policies this is the nominal robot.
        """
        return self.rows[0]["metrics"] if self.rows else {}

    @property
    def success(self) -> float | None:
        """Success rate in the first test condition, for walking the rate without a fall; None: not evaluated."""
        rates = [self.metrics[key]["value"] for key in SUCCESSES if key in self.metrics]
        falls = self.metrics.get("fall_rate", {"value": None})["value"]
        return rates[0] if rates else None if falls is None else 1.0 - falls

    @property
    def error(self) -> dict[str, Any] | None:
        """Error in the first test condition, such as the mean apex error, as in metrics.json; None: not evaluated."""
        return next((self.metrics[key] for key in ERRORS if key in self.metrics), None)


def find_policy(name: str | Path) -> Path:
    """Return the folder of a policy: the project's policy called `name` (- counts as _), else `name` as a path.

    Raises PolicyError: there is no such policy or folder, or it is that of a training without a checkpoint.
    """
    path = Path(name)
    if own := _own_policy(path):
        return own
    if not path.is_dir():
        raise PolicyError(_no_policy(str(name), path))
    runs = [file.parent for pattern in (METRICS_FILE, f"*/{METRICS_FILE}") for file in path.glob(pattern)]
    if runs and not any(map(is_run_folder, runs)):
        raise PolicyError(f"{path}: no checkpoint yet; a training saves them at its end and each --save-interval")
    return path


def _own_policy(name: Path) -> Path | None:
    """Return the folder of the project's policy of this name (- counts as _), None: there is none."""
    folder = POLICIES / str(name).replace("-", "_")
    return folder if len(name.parts) == 1 and (folder / MANIFEST).is_file() else None


def is_run_folder(folder: Path) -> bool:
    """Return whether a folder holds checkpoints of a training, also of rsl-rl."""
    return any(folder.glob("checkpoints/*.pt")) or any(folder.glob("model_[0-9]*.pt"))


def newest_run(source: str | Path) -> str | Path:
    """Return the newest run with a checkpoint in the log folder of a task, `logs/TASK`; another source unchanged."""
    path = Path(source)
    if _own_policy(path) or not path.is_dir():
        return source
    return newest(filter(is_run_folder, path.glob("*"))) or source


def _no_policy(text: str, path: Path) -> str:
    """Return the error message for a name or path that is no policy: the task's policies, or similar names."""
    if path.is_file():
        return f"{path} is a file; give the folder of a policy or of a training run, or a checkpoint"
    if len(path.parts) > 1 or path.suffix:
        return f"{path}: no such folder (policy)"
    tasks, task = policy_tasks(), task_name(text)
    if task is not None:
        names = ", ".join(policy for policy, trained_on in tasks.items() if trained_on == task)
        hint = f"its policies: {names}" if names else f"it has no policy yet: jumper train {task} trains one"
        return f"{text!r} is a task, not a policy; {hint}"
    return f"no policy {text!r:.60}{suggestion(text, tasks) or '; there are ' + ', '.join(tasks)}"


def summarise(folder: Path) -> PolicySummary:
    """Return a policy's metrics and description, after verifying its files.

    Raises PolicyError: it is no policy, or a file is missing, altered or malformed, or a link to another folder.
    """
    try:
        files, readme = read_files(folder).content, folder / README
        interface = PolicyInterface.from_json(parse_object(folder / CONFIG, files[CONFIG]).get("interface"))
        if METRICS not in files and os.path.lexists(folder / METRICS):
            raise PolicyError(f"{METRICS} is not in {MANIFEST}")
        if os.path.dirname(os.path.realpath(readme)) != os.path.realpath(folder):
            raise PolicyError(f"{README} is a link to another folder")
        about = first_paragraph(read_file(readme, "page").decode()) if os.path.lexists(readme) else ""
        saved = parse_object(folder / METRICS, files[METRICS]) if METRICS in files else {"rows": []}
        rows = saved["rows"] if "rows" in saved else [{"condition": "as evaluated", "seed": 0, **saved}]
        for row in rows:
            _check_row(row)
        return PolicySummary(folder.resolve().name, folder, interface.task, about, len(files[ONNX]), rows)
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    raise PolicyError(f"{folder}: not a policy's folder ({reason}); jumper export makes one of a training run")


def _check_row(row: dict[str, Any]) -> None:
    """Raise PolicyError, or LookupError or such, unless metrics in one condition are as in docs/metrics.schema.json."""
    metrics = row["metrics"].values()
    numbers = [metric["value"] for key, metric in row["metrics"].items() if key in (*SUCCESSES, *ERRORS, "fall_rate")]
    valid = isinstance(row["condition"], str) and isinstance(row["conditions"], dict) and metrics
    valid = valid and all(type(number) in (int, float, type(None)) for number in numbers)
    valid = valid and all(type(metric["trials"]) in (int, type(None)) for metric in metrics)
    if not valid or not all(isinstance(metric["unit"], str | None) for metric in metrics):
        raise PolicyError(f"{METRICS}: metrics of another type than docs/metrics.schema.json has")


def first_paragraph(markdown: str) -> str:
    """Return the first paragraph of a page on one line, without headings, pictures, code and the markup of links."""
    for block in markdown.split("\n\n"):
        if not block.startswith(("#", "!", "    ", "|", "-", "```")) and block.strip():
            text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(block.split()))
            return text.replace("`", "").replace("**", "")
    return ""

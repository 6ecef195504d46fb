"""Folders of policies, without PyTorch: look-up by name, verified files, atomic updates, summaries of metrics.

A folder holds `policy.onnx` (weights, normaliser, interface), `config.json` (interface, environment, training, commit,
versions), added files (`metrics.json`, a learning curve), and `manifest.json` with the SHA-256 of each of these. The
manifest does not cover `README.md`. Checksums detect damage and mix-ups; they are not a signature.

An update first adds the SHA-256 of the new files to the manifest as `updating`, then replaces the files, then writes
the final manifest. So a reader accepts the old or the new content of each file in between, and a policy stays loadable
if the update ends anywhere, such as on a full disk.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jumper_warp.policies.spec import PolicyError, PolicyInterface
from jumper_warp.registry import task_name
from jumper_warp.rl.metrics_file import METRICS_FILE
from jumper_warp.rl.run_names import SEED, newest, seed_folders, split_seed
from jumper_warp.utils.assets import POLICIES, policy_tasks
from jumper_warp.utils.checks import version_error
from jumper_warp.utils.errors import InputError, suggestion
from jumper_warp.utils.files import Json, directory_lock, json_bytes, parse_json, read_file, write_atomically

MANIFEST = "manifest.json"
CONFIG = "config.json"
ONNX = "policy.onnx"
README = "README.md"
METRICS = "metrics.json"
PICTURE = "picture.webp"
PICTURES = (".png", ".webp", ".jpg", ".gif")  # Suffixes of files that a policy does not need
FORMAT = "jumper-warp policy"
SCHEMA_VERSION = 3
PURPOSE = "file of a policy"
REPLACED = {
    "slippery_jump": "horizontal_jump", "slippery_waiting_jump": "horizontal_jump",
    "omnidirectional_jump": "horizontal_jump", "mars_vertical_jump_stock": "mars_vertical_jump",
    "walking_flat": "walking", "walking_rough": "walking",
}  # fmt: skip
"""Policy in place of each earlier one."""
FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
RSL_RL = re.compile(r"model_(\d+)\.pt")  # Names of rsl-rl's checkpoints, with the iteration
SUCCESSES = ("in_range_success_rate", "success_rate", "settled_without_collision_rate")
"""Keys of the success rate; a policy's is the first one that its metrics have."""
ERRORS = (
    "in_range_apex_error_abs_mean_m", "in_range_goal_distance_at_rest_mean_m", "apex_error_abs_mean_m",
    "goal_distance_at_rest_mean_m", "settled_rmse_vx_m_s", "error_at_end_mean_deg",
)  # fmt: skip
"""Keys of the error; a policy's is the first one that its metrics have."""


# ---------------------------------------------------------------------- look-up


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
    if runs and not any(map(is_run, runs)):
        raise PolicyError(f"{path}: no checkpoint yet; a training saves them at its end and each --save-interval")
    return path


def open_source(source: str | Path) -> tuple[str | Path, Json, bytes]:
    """Return the name or folder of a policy, and its verified configuration and ONNX file; both empty for a run.

    source: a task's log folder becomes its newest run, see `newest_run`. Raises PolicyError as `find_policy` and
    `read_files`, and CheckpointError as `newest_run`.
    """
    source = newest_run(source)
    if is_run(source):
        return source, {}, b""
    folder = find_policy(source)
    files = read_files(folder)
    config = parse_object(folder / CONFIG, files[CONFIG])
    check_version(folder / CONFIG, config)
    return source, config, files[ONNX]


def _own_policy(name: Path) -> Path | None:
    """Return the folder of the project's policy of this name (- counts as _), None: there is none."""
    folder = POLICIES / str(name).replace("-", "_")
    return folder if len(name.parts) == 1 and (folder / MANIFEST).is_file() else None


def is_run(source: str | Path) -> bool:
    """Return whether `source` is a checkpoint, or a training run's folder with checkpoints, also of rsl-rl."""
    path = Path(source)
    patterns = ("checkpoints/*.pt", f"{SEED}*/checkpoints/*.pt", "model_[0-9]*.pt")
    return path.suffix == ".pt" or any(any(path.glob(pattern)) for pattern in patterns)


def run_folder(source: Path) -> Path:
    """Return the folder of the training run that a checkpoint (.pt) belongs to; any other path unchanged."""
    if source.suffix != ".pt":
        return source
    return source.parent if RSL_RL.fullmatch(source.name) else source.parents[1]


def newest_run(source: str | Path) -> str | Path:
    """Return the newest run with a checkpoint in the log folder of a task, `logs/TASK`; another source unchanged.

    Of a run of several seeds, return the folder of the seed N that `source` names, as RUN:N, or of the median seed; see
    `seed_of`. Raises CheckpointError: the run has no such seed.
    """
    path, seed = split_seed(source)
    if _own_policy(path) or not path.is_dir():
        return source
    if not path.name.startswith(SEED) and not any(path.glob(f"{SEED}*/")):
        path = newest(filter(is_run, path.glob("*/"))) or path
    if seed is not None or seed_folders(path):
        from jumper_warp.rl.checkpoint import seed_of  # imports PyTorch

        path = seed_of(path, seed)
    return source if path == Path(source) else path


def _no_policy(text: str, path: Path) -> str:
    """Return the error message for a name or path that is no policy: the task's policies, or similar names."""
    if path.is_file():
        return f"{path} is a file; give the folder of a policy or of a training run"
    if len(path.parts) > 1 or path.suffix:
        return f"{path}: no such folder (policy)"
    if instead := REPLACED.get(text.replace("-", "_")):
        return f"{text} is no longer included: use {instead}"
    tasks = policy_tasks()
    task = task_name(text)
    if task is not None:
        names = ", ".join(policy for policy, trained_on in tasks.items() if trained_on == task)
        hint = f"its policies: {names}" if names else f"it has no policy yet: jumper train {task} trains one"
        return f"{text!r} is a task, not a policy; {hint}"
    return f"no policy {text!r:.60}{suggestion(text, tasks) or '; there are ' + ', '.join(tasks)}"


# ---------------------------------------------------------------------- files


def read_files(folder: Path) -> dict[str, bytes]:
    """Return the verified content of a policy's files by name, also while another process updates them.

    If a check fails and the manifest has changed meanwhile, there was an update, and the files are read once more.
    Pictures may be missing. Raises PolicyError: another file is missing, one is truncated or altered, or the manifest
    is malformed or of another version.
    """
    folder = Path(folder)
    path = folder / MANIFEST
    while True:
        data = read_file(path, PURPOSE, error=PolicyError)
        try:
            return _verified(folder, parse_object(path, data))
        except PolicyError:
            if read_file(path, PURPOSE, error=PolicyError) == data:
                raise


def _verified(folder: Path, manifest: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the files of a policy's folder that its manifest lists. Raises PolicyError as `read_files`.

    A file may have the old or the new content of an update that is under way or was cut off.
    """
    path = folder / MANIFEST
    if manifest.get("format") != FORMAT:
        raise PolicyError(f"{path}: not the manifest of a {FORMAT}")
    check_version(path, manifest)
    saved = manifest.get("sha256")
    updating = manifest.get("updating", {})
    if not isinstance(saved, dict) or not isinstance(updating, dict):
        raise PolicyError(f"{path}: has no table of checksums")
    files = {}
    for name in dict.fromkeys((CONFIG, ONNX, *saved, *updating)):
        if not FILE_NAME.fullmatch(name):
            raise PolicyError(f"{path}: names a file {name!r:.60}")
        may_lack = name.endswith(PICTURES) or name not in (CONFIG, ONNX, *saved)  # not yet written by the update
        if may_lack and not os.path.lexists(folder / name):
            continue
        files[name] = read_file(folder / name, PURPOSE, error=PolicyError)
        if hashlib.sha256(files[name]).hexdigest() not in (saved.get(name), updating.get(name)):
            raise PolicyError(f"{folder / name}: truncated or altered, its SHA-256 is not the manifest's")
    return files


def write_files(folder: Path, files: Mapping[str, bytes], old: Mapping[str, bytes]) -> None:
    """Write files of a policy (name to content) and its manifest; old: the folder's files, which the manifest keeps.

    An empty `old` means a new folder: its manifest is written last, and without one the folder is not a policy. Other
    processes may read an existing folder meanwhile. The caller holds `directory_lock` of the folder's parent, unless no
    other process or thread writes to the folder.
    Raises PolicyError: a name is not that of a file in a folder. OSError: the disk is full or the folder cannot be
    written.
    """
    if wrong := [name for name in files if not FILE_NAME.fullmatch(name) or name == MANIFEST]:
        raise PolicyError(f"{folder}: a policy cannot hold a file {wrong[0]!r:.60}")
    present = {name: hashlib.sha256(data).hexdigest() for name, data in old.items()}
    written = {name: hashlib.sha256(data).hexdigest() for name, data in files.items() if name != README}
    manifest = {"format": FORMAT, "schema_version": SCHEMA_VERSION, "sha256": present}
    if old:
        write_atomically(folder / MANIFEST, json_bytes(manifest | {"updating": written}))
    for name, data in files.items():
        write_atomically(folder / name, data)
    write_atomically(folder / MANIFEST, json_bytes(manifest | {"sha256": dict(sorted((present | written).items()))}))


def add_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Add or replace files of a policy, such as its metrics or plots, after verifying the folder.

    Raises PolicyError: the folder is not an intact policy. OSError as `write_files`.
    """
    folder = Path(folder)
    with directory_lock(folder.resolve().parent):
        write_files(folder, files, read_files(folder))


def check_version(path: Path, content: Mapping[str, Any]) -> None:
    """Raise PolicyError unless a JSON file's content has the present schema version."""
    if (version := content.get("schema_version")) != SCHEMA_VERSION:
        raise PolicyError(f"{path}: {version_error(f'{version!r:.20}', SCHEMA_VERSION)}")


def parse_object(path: Path, data: bytes) -> Json:
    """Return the JSON object in `data`; path: for messages. Raises PolicyError: it is none."""
    content = parse_json(data, str(path), PolicyError)
    if not isinstance(content, dict):
        raise PolicyError(f"{path}: not a JSON object")
    return content


# ---------------------------------------------------------------------- summary


@dataclass(frozen=True)
class PolicySummary:
    """Description and metrics of a policy, from the files in its folder."""

    name: str  # Name of the folder
    folder: Path
    task: str
    about: str  # First paragraph of README.md, without markup
    size_bytes: int  # Size of policy.onnx
    rows: list[Json]
    """Metrics by condition, as in metrics.json: condition, seed, conditions, metrics; empty: not evaluated."""

    @property
    def metrics(self) -> Json:
        """Metrics of the policy's first test condition, as in metrics.json; may be empty.

        In the project's policies this is the nominal robot.
        """
        return self.rows[0]["metrics"] if self.rows else {}

    @property
    def success(self) -> float | None:
        """Success rate in the first test condition, for walking the rate without a fall; None: not evaluated.

        That of a jump is over the range of commands of its task's evaluation in which it should succeed.
        """
        rates = [self.metrics[key]["value"] for key in SUCCESSES if key in self.metrics]
        falls = self.metrics.get("fall_rate", {"value": None})["value"]
        return rates[0] if rates else None if falls is None else 1.0 - falls

    @property
    def error(self) -> Json | None:
        """Error in the first test condition, such as the mean apex error, as in metrics.json; None: not evaluated."""
        return next((self.metrics[key] for key in ERRORS if key in self.metrics), None)


def summarise(folder: Path) -> PolicySummary:
    """Return a policy's metrics and description, after verifying its files.

    Raises PolicyError: it is no policy, or a file is missing, altered or malformed.
    """
    folder = Path(folder)
    try:
        files = read_files(folder)
        interface = PolicyInterface.from_json(parse_object(folder / CONFIG, files[CONFIG])["interface"])
        if METRICS not in files and os.path.lexists(folder / METRICS):
            raise PolicyError(f"{METRICS} is not in {MANIFEST}")
        readme = folder / README
        if os.path.dirname(os.path.realpath(readme)) != os.path.realpath(folder):
            raise PolicyError(f"{README} is a link to another folder")
        about = first_paragraph(read_file(readme, PURPOSE).decode()) if os.path.lexists(readme) else ""
        saved = parse_object(folder / METRICS, files[METRICS]) if METRICS in files else {"rows": []}
        rows = saved["rows"] if "rows" in saved else [{"condition": "as evaluated", "seed": 0, **saved}]
        for row in rows:
            _check_row(row)
        return PolicySummary(folder.resolve().name, folder, interface.task, about, len(files[ONNX]), rows)
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        message = f"{folder}: not a policy's folder ({reason}); jumper export makes one of a training run"
        raise PolicyError(message) from error


def _check_row(row: Json) -> None:
    """Raise PolicyError, or LookupError or such, unless metrics in one condition are as in docs/metrics.schema.json."""
    metrics = row["metrics"].values()
    shown = (*SUCCESSES, *ERRORS, "fall_rate")
    numbers = [metric["value"] for key, metric in row["metrics"].items() if key in shown]
    numbers += [metric["trials"] for metric in metrics]
    texts = [metric["unit"] for metric in metrics]
    valid = isinstance(row["condition"], str) and isinstance(row["conditions"], dict) and metrics
    valid = valid and all(type(number) in (int, float, type(None)) for number in numbers)
    if not valid or not all(isinstance(text, str | None) for text in texts):
        raise PolicyError(f"{METRICS}: metrics of another type than docs/metrics.schema.json has")


def first_paragraph(markdown: str) -> str:
    """Return the first paragraph of a page on one line, without headings, pictures, code and the markup of links."""
    for block in markdown.split("\n\n"):
        if not block.startswith(("#", "!", "    ", "|", "-", "```")) and block.strip():
            text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(block.split()))
            return text.replace("`", "").replace("**", "")
    return ""

"""The folder that a policy is kept in.

It holds `policy.onnx` (weights, normaliser, interface), `config.json` (interface, environment, training, commit,
versions), whatever is added (`metrics.json`, a learning curve), and `manifest.json` with the SHA-256 of each of these.
A `README.md` beside them is prose and not in the manifest. The sums find damage and mix-ups; they are no signature.
Nothing that is loaded can execute code.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from jumper_warp.policies.onnx import onnx_bytes, policy_from_onnx
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.spec import PolicyError, PolicyInterface
from jumper_warp.utils.assets import ASSETS
from jumper_warp.utils.checks import version_error
from jumper_warp.utils.files import json_bytes, write_atomically
from jumper_warp.utils.runtime import source_versions

POLICIES = ASSETS / "policies"
"""Where the project's own policies lie."""
FORMAT = "jumper-warp policy"
SCHEMA_VERSION = 2
MANIFEST = "manifest.json"
CONFIG = "config.json"
ONNX = "policy.onnx"
README = "README.md"
MAX_BYTES = 256 * 2**20
"""Larger files are refused unread."""
FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
NO_FOLDERS = (".pt", ".pth", ".onnx", ".safetensors")
"""Ends of names that files have."""


def save_policy(
    folder: Path, policy: Policy, *, files: Mapping[str, bytes] | None = None, overwrite: bool = False
) -> Path:
    """Write a policy's folder, whole or not at all; return its path.

    Commit and versions are added to the policy's configuration unless it brings its own. files: more files by name,
    such as a learning curve. overwrite: whether a policy that is there already is replaced, with all its files.
    Raises PolicyError: the folder exists and is not to be overwritten, or is no policy's; or a name is malformed.
    """
    folder = checked_folder(folder)
    if folder.exists() and not (overwrite and (folder / MANIFEST).is_file()):
        raise PolicyError(f"{folder} exists" + ("" if not overwrite else " and is no policy's"))
    config = {**source_versions(), **policy.config}
    config |= {"schema_version": SCHEMA_VERSION, "interface": policy.interface.to_json()}
    content = {
        **(files or {}),
        CONFIG: json_bytes(config),
        ONNX: onnx_bytes(policy, config),
        README: default_readme(policy).encode(),
    }
    aside = folder.with_name(f".{folder.name}.{os.getpid()}")
    old = folder.with_name(f".{folder.name}.{os.getpid()}.old")
    aside.mkdir(parents=True)
    try:
        _write(aside, content, {})
        if folder.exists():
            os.replace(folder, old)
        os.replace(aside, folder)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)
    return folder


def checked_folder(folder: Path) -> Path:
    """Return where a policy is to be saved. Raises PolicyError: the name is that of a file."""
    folder = Path(folder)
    if folder.suffix.lower() in NO_FOLDERS:
        raise PolicyError(f"a policy is saved as a folder, whose name cannot end in {folder.suffix}: got {folder}")
    return folder


def add_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Add or replace files of a policy, such as its plots. The rest of the folder is checked first.

    Raises PolicyError: the folder is not a whole policy, or a name is malformed or one of the policy's own.
    """
    folder = Path(folder)
    sums = _checked_sums(folder)
    taken = sorted({CONFIG, ONNX, MANIFEST} & set(files))
    if taken:
        raise PolicyError(f"{folder}: {taken[0]} is the policy itself")
    _write(folder, files, sums)


def _write(folder: Path, files: Mapping[str, bytes], sums: Mapping[str, str]) -> None:
    """Write files, and last the manifest of these and of `sums`."""
    for name in files:
        if not FILE_NAME.fullmatch(name) or name == MANIFEST:
            raise PolicyError(f"a policy cannot hold a file named {name!r:.60}")
    sums = {**sums, **{name: hashlib.sha256(data).hexdigest() for name, data in files.items() if name != README}}
    manifest = {"format": FORMAT, "schema_version": SCHEMA_VERSION, "sha256": dict(sorted(sums.items()))}
    for name, data in {**files, MANIFEST: json_bytes(manifest)}.items():
        write_atomically(folder / name, data)


def list_policies() -> tuple[str, ...]:
    """Return the names of the project's own policies."""
    return tuple(sorted(path.parent.name for path in POLICIES.glob(f"*/{MANIFEST}")))


def find_policy(name: str | Path) -> Path:
    """Return the folder of one of the project's policies by name (- for _ will do), or a policy's folder.

    Raises PolicyError: there is none.
    """
    text = str(name)
    own = POLICIES / text.replace("-", "_")
    if FILE_NAME.fullmatch(text) and (own / MANIFEST).is_file():
        return own
    if not Path(name).is_dir():
        raise PolicyError(f"no policy {text!r}: give a policy's folder or one of: {', '.join(list_policies()) or '-'}")
    return Path(name)


def load_policy(name: str | Path, device: str | torch.device = "cpu") -> Policy:
    """Return a policy by name or folder, with every file checked. See `find_policy`.

    Raises PolicyError: the policy is missing, truncated, altered, of another version, or its weights are not finite or
    not of the shape that its configuration asks for.
    """
    folder = find_policy(name)
    sums = _checked_sums(folder)
    config = _json(folder / CONFIG, _checked_bytes(folder / CONFIG, sums[CONFIG]))
    _check_version(folder / CONFIG, config)
    data = _checked_bytes(folder / ONNX, sums[ONNX])
    try:
        interface = PolicyInterface.from_json(config.get("interface"))
        return policy_from_onnx(data, interface, config).to(device)
    except PolicyError as error:
        raise PolicyError(f"{folder}: {error}") from error


def _checked_sums(folder: Path) -> dict[str, str]:
    """Return the sums of a manifest of this version, with all its files present and unaltered."""
    path = folder / MANIFEST
    manifest = _json(path, _bytes(path))
    if manifest.get("format") != FORMAT:
        raise PolicyError(f"{path}: not the manifest of a {FORMAT}")
    _check_version(path, manifest)
    sums = manifest.get("sha256")
    if not isinstance(sums, dict) or not {CONFIG, ONNX} <= set(sums):
        raise PolicyError(f"{path}: lacks the sums of {CONFIG} and {ONNX}")
    for name, digest in sums.items():
        if not FILE_NAME.fullmatch(name):
            raise PolicyError(f"{path}: names a file {name!r:.60}")
        _checked_bytes(folder / name, digest)
    return sums


def _check_version(path: Path, content: Mapping[str, Any]) -> None:
    if (found := content.get("schema_version")) != SCHEMA_VERSION:
        raise PolicyError(f"{path}: {version_error(f'{found!r:.20}', SCHEMA_VERSION)}")


def _checked_bytes(path: Path, digest: Any) -> bytes:
    data = _bytes(path)
    if hashlib.sha256(data).hexdigest() != digest:
        raise PolicyError(f"{path}: truncated or altered, its SHA-256 is not the manifest's")
    return data


def _bytes(path: Path) -> bytes:
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise PolicyError(f"{path}: cannot be read (not a file)")
        if status.st_size > MAX_BYTES:
            raise PolicyError(f"{path}: larger than {MAX_BYTES >> 20} MiB")
        return path.read_bytes()
    except OSError as error:
        raise PolicyError(f"{path}: cannot be read ({error.strerror})") from error


def _json(path: Path, data: bytes) -> dict[str, Any]:
    try:
        content = json.loads(data)
        json_bytes(content)  # neither NaN nor half a character, which could not be written again
    except (ValueError, RecursionError) as error:
        raise PolicyError(f"{path}: not JSON ({type(error).__name__})") from error
    if not isinstance(content, dict):
        raise PolicyError(f"{path}: not a JSON object")
    return content


def default_readme(policy: Policy) -> str:
    """Return a few lines on what a policy's folder holds and how to use it."""
    face = policy.interface
    return (
        f"# Policy for {face.task}\n\n"
        f"Reads {face.sizes[0]} numbers, drives {face.sizes[-1]} motors at {1.0 / face.policy_dt:.0f} Hz.\n"
        f"`{ONNX}` holds the network with its normaliser, `{CONFIG}` everything that made it.\n\n"
        "    jumper play FOLDER\n"
        "    jumper evaluate FOLDER\n"
    )

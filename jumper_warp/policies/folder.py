"""Saving and loading of policies as folders.

It holds `policy.onnx` (weights, normaliser, interface), `config.json` (interface, environment, training, commit,
versions), added files (`metrics.json`, a learning curve), and `manifest.json` with the SHA-256 of each of these. The
manifest does not cover `README.md`. Checksums detect damage and mix-ups; they are not a signature. Loading executes no
code.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jumper_warp.policies.catalog import CONFIG, MANIFEST, ONNX, README, find_policy
from jumper_warp.policies.onnx import onnx_bytes, policy_from_onnx
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.spec import PolicyError, PolicyInterface
from jumper_warp.utils.checks import version_error
from jumper_warp.utils.files import json_bytes, parse_json, read_file, write_atomically
from jumper_warp.utils.runtime import source_versions

FORMAT = "jumper-warp policy"
SCHEMA_VERSION = 3
PURPOSE = "file of a policy"
PICTURES = (".png", ".webp", ".jpg", ".gif")  # Suffixes of files that a policy does not need
FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
FILE_SUFFIXES = (".pt", ".pth", ".onnx", ".safetensors")  # Suffixes that a policy's folder may not have


def save_policy(
    folder: Path, policy: Policy, *, files: Mapping[str, bytes] | None = None, overwrite: bool = False
) -> Path:
    """Write a policy to a folder atomically, and return the folder's path.

    Commit and versions are added to the configuration if it has none. files: content of additional files by name.
    overwrite: whether to replace an existing policy with all its files.
    Raises PolicyError: the folder exists and overwrite is not set, or it is not a policy's; or a name is malformed.
    """
    folder = checked_folder(folder, overwrite)
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


def checked_folder(folder: Path, overwrite: bool) -> Path:
    """Return a path for a policy's folder, after checking that a policy can be written there.

    Raises PolicyError: it has no name or the suffix of a file; it exists and overwrite is not set, or is no policy's.
    """
    folder = Path(folder)
    if folder.name in ("", ".."):
        raise PolicyError(f"a policy's folder needs a name, got {folder}")
    if folder.suffix.lower() in FILE_SUFFIXES:
        raise PolicyError(f"a policy is saved as a folder, whose name cannot end in {folder.suffix}: got {folder}")
    if folder.exists() and not (overwrite and (folder / MANIFEST).is_file()):
        reason = " and is not a policy's folder" if overwrite else "; overwrite replaces it"
        raise PolicyError(f"{folder} exists{reason}")
    return folder


def add_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Add or replace files of a policy, such as its plots, after verifying the folder.

    Raises PolicyError: the folder is not an intact policy, or a name is malformed or one of the policy's own.
    """
    folder = Path(folder)
    checksums = _verified_checksums(folder)
    reserved = sorted({CONFIG, ONNX, MANIFEST} & set(files))
    if reserved:
        raise PolicyError(f"{folder}: {reserved[0]} is the policy itself")
    _write(folder, files, checksums)


def _write(folder: Path, files: Mapping[str, bytes], checksums: Mapping[str, str]) -> None:
    """Write a policy's files (name to content), then its manifest. Raises PolicyError: a name is malformed.

    checksums: SHA-256 by name of the files that the folder has already; the manifest keeps them.
    """
    for name in files:
        if not FILE_NAME.fullmatch(name) or name == MANIFEST:
            raise PolicyError(f"a policy cannot hold a file named {name!r:.60}")
    written = {name: hashlib.sha256(data).hexdigest() for name, data in files.items() if name != README}
    sha256 = dict(sorted({**checksums, **written}.items()))
    manifest = {"format": FORMAT, "schema_version": SCHEMA_VERSION, "sha256": sha256}
    for name, data in {**files, MANIFEST: json_bytes(manifest)}.items():
        write_atomically(folder / name, data)


def read_policy(name: str | Path) -> Policy:
    """Return a policy by name or folder (see `find_policy`), after verifying every file; pictures may be missing.

    Raises PolicyError: the policy is missing, truncated, altered, of another version, or its weights are not finite or
    not of the shape in its configuration.
    """
    folder = find_policy(name)
    checksums = _verified_checksums(folder)
    config = _parse_json(folder / CONFIG, _read_verified(folder / CONFIG, checksums[CONFIG]))
    _check_version(folder / CONFIG, config)
    data = _read_verified(folder / ONNX, checksums[ONNX])
    try:
        interface = PolicyInterface.from_json(config.get("interface"))
        return policy_from_onnx(data, interface, config)
    except PolicyError as error:
        raise PolicyError(f"{folder}: {error}") from error


def _verified_checksums(folder: Path) -> dict[str, str]:
    """Verify a policy's version and files, and return the manifest's SHA-256 by file name.

    Raises PolicyError.
    """
    path = folder / MANIFEST
    manifest = _parse_json(path, read_file(path, PURPOSE, error=PolicyError))
    if manifest.get("format") != FORMAT:
        raise PolicyError(f"{path}: not the manifest of a {FORMAT}")
    _check_version(path, manifest)
    checksums = manifest.get("sha256")
    if not isinstance(checksums, dict) or not {CONFIG, ONNX} <= set(checksums):
        raise PolicyError(f"{path}: lacks the checksums of {CONFIG} and {ONNX}")
    for name, digest in checksums.items():
        if not FILE_NAME.fullmatch(name):
            raise PolicyError(f"{path}: names a file {name!r:.60}")
        if not name.endswith(PICTURES) or os.path.lexists(folder / name):
            _read_verified(folder / name, digest)
    return checksums


def _check_version(path: Path, content: Mapping[str, Any]) -> None:
    """Raise PolicyError unless a JSON file's content has the present schema version."""
    if (version := content.get("schema_version")) != SCHEMA_VERSION:
        raise PolicyError(f"{path}: {version_error(f'{version!r:.20}', SCHEMA_VERSION)}")


def _read_verified(path: Path, digest: Any) -> bytes:
    """Read a policy's file, and verify its SHA-256.

    Raises PolicyError: it cannot be read, or its SHA-256 is not `digest`.
    """
    data = read_file(path, PURPOSE, error=PolicyError)
    if hashlib.sha256(data).hexdigest() != digest:
        raise PolicyError(f"{path}: truncated or altered, its SHA-256 is not the manifest's")
    return data


def _parse_json(path: Path, data: bytes) -> dict[str, Any]:
    """Return the JSON object in `data`; path: for messages. Raises PolicyError: it is none."""
    content = parse_json(data, str(path), PolicyError)
    if not isinstance(content, dict):
        raise PolicyError(f"{path}: not a JSON object")
    return content


def default_readme(policy: Policy) -> str:
    """Return the text of README.md for a policy's folder: sizes, rate, files and commands."""
    interface = policy.interface
    rate = 1.0 / interface.policy_dt
    return (
        f"# Policy for {interface.task}\n\n"
        f"Reads {interface.sizes[0]} numbers, drives {interface.sizes[-1]} motors at {rate:.0f} Hz.\n"
        f"`{ONNX}` holds the network with its normaliser, `{CONFIG}` everything that made it.\n\n"
        "    jumper play FOLDER\n"
        "    jumper evaluate FOLDER\n"
    )

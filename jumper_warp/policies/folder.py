"""Saving and loading of policies as folders.

It holds `policy.onnx` (weights, normaliser, interface), `config.json` (interface, environment, training, commit,
versions), added files (`metrics.json`, a learning curve), and `manifest.json` with the SHA-256 of each of these. The
manifest does not cover `README.md`. Checksums detect damage and mix-ups; they are not a signature. Loading executes no
code.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path

from jumper_warp.policies.catalog import find_policy
from jumper_warp.policies.manifest import (
    CONFIG,
    MANIFEST,
    ONNX,
    README,
    SCHEMA_VERSION,
    check_version,
    parse_object,
    read_files,
    write_files,
)
from jumper_warp.policies.onnx import onnx_bytes, policy_from_onnx
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.spec import PolicyError, PolicyInterface
from jumper_warp.utils.files import json_bytes
from jumper_warp.utils.locks import directory_lock
from jumper_warp.utils.runtime import source_versions

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
    token = secrets.token_hex(4)
    aside, old = (folder.with_name(f".{folder.name}.{token}{end}") for end in ("", ".old"))
    aside.mkdir(parents=True)
    try:
        write_files(aside, content, {})
        with directory_lock(folder.parent):
            if folder.exists():
                os.replace(folder, old)
            os.replace(aside, folder)
    finally:
        if old.exists() and not folder.exists():
            os.rename(old, folder)
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
    reserved = sorted({CONFIG, ONNX, MANIFEST} & set(files))
    if reserved:
        raise PolicyError(f"{folder}: {reserved[0]} is the policy itself")
    with directory_lock(folder.resolve().parent):
        write_files(folder, files, read_files(folder).checksums)


def read_policy(name: str | Path) -> Policy:
    """Return a policy by name or folder (see `find_policy`), after verifying every file; pictures may be missing.

    Raises PolicyError: the policy is missing, truncated, altered, of another version, or its weights are not finite or
    not of the shape in its configuration.
    """
    folder = find_policy(name)
    files = read_files(folder).content
    config = parse_object(folder / CONFIG, files[CONFIG])
    check_version(folder / CONFIG, config)
    try:
        interface = PolicyInterface.from_json(config.get("interface"))
        return policy_from_onnx(files[ONNX], interface, config)
    except PolicyError as error:
        raise PolicyError(f"{folder}: {error}") from error


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

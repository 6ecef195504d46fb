"""Files of a policy's folder and their SHA-256 in `manifest.json`: verified reading, updates that may be interrupted.

It needs no PyTorch. An update first adds the SHA-256 of the new files to the manifest as `updating`, then replaces the
files, then writes the final manifest. So a reader accepts the old or the new content of each file in between, and a
policy stays loadable if the update ends anywhere, such as on a full disk.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jumper_warp.policies.spec import PolicyError
from jumper_warp.utils.checks import version_error
from jumper_warp.utils.files import json_bytes, parse_json, read_file, write_atomically

MANIFEST = "manifest.json"
CONFIG = "config.json"
ONNX = "policy.onnx"
README = "README.md"
FORMAT = "jumper-warp policy"
SCHEMA_VERSION = 3
PURPOSE = "file of a policy"
PICTURES = (".png", ".webp", ".jpg", ".gif")  # Suffixes of files that a policy does not need
FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


class PolicyFiles(NamedTuple):
    """Verified files of a policy's folder, by name."""

    checksums: dict[str, str]  # SHA-256 of each file
    content: dict[str, bytes]  # Content of all files but missing pictures


def read_files(folder: Path) -> PolicyFiles:
    """Read and verify the files of a policy's folder, also while another process updates them.

    Raises PolicyError: a file is missing, truncated or altered, or the manifest is malformed or of another version.
    """
    path = folder / MANIFEST
    while True:
        data = read_file(path, PURPOSE, error=PolicyError)
        try:
            return _verified(folder, parse_object(path, data))
        except PolicyError:
            if read_file(path, PURPOSE, error=PolicyError) == data:
                raise


def _verified(folder: Path, manifest: Mapping[str, Any]) -> PolicyFiles:
    """Read the files of a policy's folder that its manifest lists. Raises PolicyError as `read_files`."""
    path = folder / MANIFEST
    if manifest.get("format") != FORMAT:
        raise PolicyError(f"{path}: not the manifest of a {FORMAT}")
    check_version(path, manifest)
    saved, updating = manifest.get("sha256"), manifest.get("updating", {})
    if not isinstance(saved, dict) or not isinstance(updating, dict) or not {CONFIG, ONNX} <= set(saved):
        raise PolicyError(f"{path}: lacks the checksums of {CONFIG} and {ONNX}")
    files = PolicyFiles({}, {})
    for name in {**saved, **updating}:
        if not FILE_NAME.fullmatch(name):
            raise PolicyError(f"{path}: names a file {name!r:.60}")
        if (name.endswith(PICTURES) or name not in saved) and not os.path.lexists(folder / name):
            if name in saved:
                files.checksums[name] = saved[name]
            continue
        data = read_file(folder / name, PURPOSE, error=PolicyError)
        digest = hashlib.sha256(data).hexdigest()
        if digest not in (saved.get(name), updating.get(name)):
            raise PolicyError(f"{folder / name}: truncated or altered, its SHA-256 is not the manifest's")
        files.checksums[name], files.content[name] = digest, data
    return files


def write_files(folder: Path, files: Mapping[str, bytes], checksums: Mapping[str, str]) -> None:
    """Write a policy's files (name to content) and its manifest. Raises PolicyError: a name is malformed; OSError.

    checksums: SHA-256 by name of the files that the folder has already; the manifest keeps them.
    """
    for name in files:
        if not FILE_NAME.fullmatch(name) or name == MANIFEST:
            raise PolicyError(f"a policy cannot hold a file named {name!r:.60}")
    written = {name: hashlib.sha256(data).hexdigest() for name, data in files.items() if name != README}
    manifest = {"format": FORMAT, "schema_version": SCHEMA_VERSION, "sha256": dict(checksums)}
    if checksums:
        write_atomically(folder / MANIFEST, json_bytes(manifest | {"updating": written}))
    for name, data in files.items():
        write_atomically(folder / name, data)
    manifest["sha256"] = dict(sorted({**checksums, **written}.items()))
    write_atomically(folder / MANIFEST, json_bytes(manifest))


def check_version(path: Path, content: Mapping[str, Any]) -> None:
    """Raise PolicyError unless a JSON file's content has the present schema version."""
    if (version := content.get("schema_version")) != SCHEMA_VERSION:
        raise PolicyError(f"{path}: {version_error(f'{version!r:.20}', SCHEMA_VERSION)}")


def parse_object(path: Path, data: bytes) -> dict[str, Any]:
    """Return the JSON object in `data`; path: for messages. Raises PolicyError: it is none."""
    content = parse_json(data, str(path), PolicyError)
    if not isinstance(content, dict):
        raise PolicyError(f"{path}: not a JSON object")
    return content

"""Record the conformance vectors of policies again, after a policy has changed.

    python -m docs.conformance_vectors vertical_jump horizontal_jump walking

It writes `assets/conformance/NAME.npz` for bundles and `NAME.json` for programs without NumPy.
"""

from __future__ import annotations

import base64
import json
import sys
import zlib

import numpy as np

from jumper_warp.bench.vectors import record_vectors
from jumper_warp.policies.policy import load_policy
from jumper_warp.utils.assets import ASSETS


def json_text(vectors: dict[str, np.ndarray]) -> str:
    """Return vectors as JSON: each array with dtype, shape and its bytes, compressed by zlib, in base64.

    Bytes are little-endian, the last index fastest; texts are lists.
    """
    content = {}
    for name, array in vectors.items():
        if array.dtype.kind == "U":
            content[name] = array.tolist()
        else:
            data = base64.b64encode(zlib.compress(np.ascontiguousarray(array).tobytes(), 9)).decode()
            content[name] = {"dtype": str(array.dtype), "shape": list(array.shape), "zlib_base64": data}
    return json.dumps(content) + "\n"


def main(names: list[str]) -> None:
    """Record and write the vectors of the named policies."""
    for name in names:
        vectors = record_vectors(load_policy(name))
        np.savez_compressed(ASSETS / "conformance" / f"{name}.npz", allow_pickle=False, **vectors)  # type: ignore[arg-type]
        (ASSETS / "conformance" / f"{name}.json").write_text(json_text(vectors))


if __name__ == "__main__":
    main(sys.argv[1:])

"""Functions that run commands, and read recorded time series."""

import numpy as np
from rerun.chunk import RrdReader

from jumper_warp.cli import main as cli


def run(capsys, *args):
    """Return exit code, output and error lines of a command."""
    code = 0
    try:
        cli.main(args)
    except SystemExit as end:
        code = end.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err.splitlines()


def curves(path):
    """Return the values of every time series of a recording by entity path."""
    series = {}
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        if "Scalars:scalars" in batch.schema.names:
            name = str(chunk.entity_path).replace("\\", "")
            series[name] = np.ravel(batch.column("Scalars:scalars").to_pylist())
    return series

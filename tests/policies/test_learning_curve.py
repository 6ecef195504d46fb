"""Learning curve of a training, as saved in a policy's folder."""

import itertools
import json

from jumper_warp.policies.policy import CURVE, CURVE_ROWS, thinned_curve


def test_thinned_curve_keeps_its_columns_and_evenly_spaced_rows():
    rows = [{"iteration": i, "Perf/elapsed_s": 0.1 * i, "Loss/value": 1.0} for i in range(1000)]
    kept = [json.loads(line) for line in thinned_curve("\n".join(map(json.dumps, rows)).encode()).splitlines()]
    assert len(kept) == CURVE_ROWS and all(set(row) == {"iteration", "Perf/elapsed_s"} <= set(CURVE) for row in kept)
    gaps = {after["iteration"] - before["iteration"] for before, after in itertools.pairwise(kept)}
    assert (kept[0]["iteration"], kept[-1]["iteration"]) == (0, 999) and gaps <= {16, 17}  # 999 / 59 = 16.9


def test_thinned_curve_keeps_short_curves_and_drops_malformed_lines():
    valid = b'{"iteration": 1}\n{"iteration": 2}\n'
    assert thinned_curve(valid + b'}\n\xff}\n{"itera') == valid

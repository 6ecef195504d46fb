"""The learning curve that a policy's folder keeps of its training."""

import itertools
import json

from jumper_warp.policies.runs import CURVE, CURVE_ROWS, thinned_curve


def test_curve_keeps_some_columns_and_evenly_spaced_rows_with_the_first_and_the_last():
    rows = [{"iteration": i, "Perf/elapsed_s": 0.1 * i, "Loss/value": 1.0} for i in range(1000)]
    kept = [json.loads(line) for line in thinned_curve("\n".join(map(json.dumps, rows)).encode()).splitlines()]
    assert len(kept) == CURVE_ROWS and all(set(row) == {"iteration", "Perf/elapsed_s"} <= set(CURVE) for row in kept)
    steps = {b["iteration"] - a["iteration"] for a, b in itertools.pairwise(kept)}
    assert (kept[0]["iteration"], kept[-1]["iteration"]) == (0, 999) and steps <= {16, 17}


def test_short_curve_stays_and_a_line_that_was_cut_off_is_left_out():
    assert thinned_curve(b'{"iteration": 1}\n{"iteration": 2}\n{"itera') == b'{"iteration": 1}\n{"iteration": 2}\n'

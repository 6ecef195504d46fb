"""The experiment on starts of identification: which fits count, and lines of an interrupted run."""

import json

import pytest

from experiments.identification_starts import Args, saved_fits, summary
from jumper_warp.utils.errors import InputError


def fit_line(robot, consistent, good):
    """Return one fit of a robot as a line of the experiment has it."""
    numbers = {"outside": 2, "identified": 70, "worst": 2.5, "mass_error_std": 0.0, "cpu_s": 10.0}
    names = {"robot": robot, "noise": 0, "consistent": consistent, "good": good, "inconsistency": ""}
    return names | numbers | {"starts": [[0.0, 0.0], [1.0, 0.5]]}


def test_summary_counts_bad_accepted_and_good_rejected_fits():
    cases = ((True, True), (True, True), (True, False), (False, True), (False, False))
    values = summary([fit_line(i, *case) for i, case in enumerate(cases)])
    assert values["accepted"] == 3 and values["accepted_bad"] == 1 and values["accepted_bad_fits"][0]["robot"] == 2
    assert values["good"] == 3 and values["good_rejected_rate"] == pytest.approx(1 / 3)


def test_line_that_was_cut_off_is_computed_again(tmp_path):
    path, line = tmp_path / "fits.jsonl", json.dumps(fit_line(0, True, True))
    assert saved_fits(path) == {}
    path.write_text(f"{line}\n{line[:40]}")
    assert list(saved_fits(path)) == [(0, 0)]


@pytest.mark.parametrize("shard", ["0/2", "3/2", "1", "a/b"])
def test_shard_out_of_range_is_refused(shard):
    with pytest.raises(InputError, match="shard must be K/N"):
        Args(shard=shard)

"""The experiment on starts of identification: which fits count, and lines of an interrupted run."""

from types import SimpleNamespace

import numpy as np
import pytest

from experiments.identification_starts import bad_probability, summary
from jumper_warp.utils.output import read_values, write_metrics


def fit_line(robot, consistent, good):
    """Return one fit of a robot as a line of the experiment has it."""
    numbers = {"outside": 2, "identified": 70, "worst": 2.5, "mass_error_std": 0.0, "cpu_s": 10.0}
    names = {"robot": robot, "noise": 0, "consistent": consistent, "good": good, "inconsistency": ""}
    numbers["bad_probability"] = 0.04
    return names | numbers | {"starts": [[0.0, 0.0], [1.0, 0.5]]}


def test_summary_counts_bad_accepted_and_good_rejected_fits(tmp_path):
    cases = ((True, True), (True, True), (True, False), (False, True), (False, False))
    values = summary([fit_line(i, *case) for i, case in enumerate(cases)])
    assert values["accepted"] == 3 and values["accepted_bad"] == 1
    assert len(values["accepted_bad_fits"]) == 1 and values["accepted_bad_fits"][0].startswith("robot 2, noise 0: 2 of")
    assert values["accepted_bad_expected"] == pytest.approx(0.12)
    assert values["good"] == 3 and values["good_rejected_rate"] == pytest.approx(1 / 3)
    write_metrics(tmp_path, values)
    assert len(read_values(tmp_path)["rejected_fits"]) == 2


def test_errors_common_to_all_parameters_make_a_fit_bad_as_often_as_one_parameter():
    common, single = np.ones((4, 4)), np.eye(4)
    for covariance, probability in ((common, 0.05), (single, 1.0 - 0.95**4)):
        fit = SimpleNamespace(covariance=0.01 * covariance, std=np.full(4, 0.1), identified=np.ones(4, dtype=bool))
        assert bad_probability(fit, np.zeros(4), np.random.default_rng(0)) == pytest.approx(probability, abs=0.02)


def test_estimates_pulled_to_the_prior_make_a_fit_bad_more_often():
    fit = SimpleNamespace(covariance=0.25 * np.eye(1), std=np.full(1, 0.5), identified=np.ones(1, dtype=bool))
    # mean error -0.25 * 4 = -1, standard deviation 0.433: 51.8 % are below the interval of 0.98
    assert bad_probability(fit, np.full(1, 4.0), np.random.default_rng(0)) == pytest.approx(0.518, abs=0.02)

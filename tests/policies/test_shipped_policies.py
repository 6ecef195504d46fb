"""Shipped policies reach the documented results in a few nominal tests.

Comments give the documented value of an error over more jumps. Rates are fractions of the jumps.
"""

from dataclasses import replace

import numpy as np
import pytest

from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.evaluation.jump_metrics import HeightFlags, LandingFlags
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.evaluation.suites import Platform, Ring
from jumper_warp.evaluation.sweeps import DistanceSweep, HeightSweep

QUIET = {"num_recorded": 0, "device": "cpu"}  # no recordings
FEW = QUIET | {"num_jumps": 8}


def test_horizontal_policy_reaches_goals_in_all_directions(tmp_path):
    values = Ring(num_jumps=16, radius=0.6, out=tmp_path, **QUIET).run()  # [m]
    assert values["goal_reached_rate"] == 1.0 and values["landed_rate"] == 1.0
    assert values["goal_distance_at_end_mean_m"] < 0.02  # 0.014 m of 64 jumps
    assert values["at_rest_rate"] > 0.8  # some still sway one second after touchdown


@pytest.mark.parametrize(("policy", "command", "rise"), [
    ("vertical_jump", HeightFlags(8, height_range=(0.5, 1.0), hold=5.0), 0.06),
    ("horizontal_jump", LandingFlags(8, goal_x=(0.4, 1.5), hold=5.0), 0.04),
])  # fmt: skip
def test_policies_stand_squat_as_deep_as_needed_and_stand_again(policy, command, rise):
    run = EvaluationRun(policy)
    run.prepare("evaluate", Conditions(device="cpu"))
    log = command.log(run.evaluation.prepare_task(run.task), 0)
    run.run_episodes(run.env(log.count), log)
    outcome = log.outcome
    assert outcome.success.all()
    for height in (outcome.stance_m, outcome.height_at_end_m):
        assert (height > 0.30).all() and (height < 0.40).all()
    squat = outcome.squat_m.ravel()
    assert squat[0] - squat[-1] > rise and (np.diff(squat) < 0.01).all()


def test_walking_policy_of_mars_follows_its_commands():
    run = EvaluationRun("mars_walking")
    run.prepare("evaluate", Conditions(device="cpu"))
    flags = replace(run.evaluation.default_flags("evaluate"), commands_per_axis=2, seconds=6.0)
    assert flags.max_velocity == (0.6, 0.5, 0.8) and run.task.gravity == 3.71
    log = flags.log(run.task, 0)
    values = flags.metrics(run.run_episodes(run.env(log.count), log))
    assert values["fall_rate"].value == 0.0
    assert values["settled_rmse_vx_m_s"].value < 0.02  # 0.0101 m/s of 4,458 walks


def test_sighted_policy_lands_on_blocks_that_a_blind_one_hits(tmp_path):
    flags = FEW | {"edge": 0.35}
    sighted = Platform(policy="sighted_jump", out=tmp_path / "sighted", **flags).run()
    blind = Platform(policy="horizontal_jump", out=tmp_path / "blind", **flags).run()
    assert sighted["block_success_rate"] == 1.0 and sighted["platform_success_rate"] == 1.0
    assert blind["block_success_rate"] < 0.9  # 0.69 of 100 jumps


def test_horizontal_policy_lands_on_slippery_ground(tmp_path):
    values = DistanceSweep(policy="horizontal_jump", num_jumps=12, friction=0.4, out=tmp_path, **QUIET).run()
    assert values["success_rate"] == 1.0 and values["goal_distance_at_end_mean_m"] < 0.015  # 0.0084 m of 1,024 jumps


def test_mars_horizontal_policy_reaches_its_distances(tmp_path):
    values = DistanceSweep(policy="mars_horizontal_jump", distance_range=(0.5, 5.0), out=tmp_path, **FEW).run()
    assert values["success_rate"] == 1.0 and values["success_without_paw_lift_rate"] == 1.0
    assert values["goal_distance_at_end_mean_m"] < 0.02  # 0.0096 m of 4,096 jumps
    assert values["gravity_m_s2"] == 3.71  # Mars


def test_mars_policy_with_springs_reaches_its_distances(tmp_path):
    values = DistanceSweep(policy="mars_springs_jump", distance_range=(0.5, 6.0), out=tmp_path, **FEW).run()
    assert values["success_rate"] == 1.0 and values["success_without_hop_rate"] == 1.0
    assert values["goal_distance_at_end_mean_m"] < 0.025  # 0.014 m of 200 jumps


def test_mars_vertical_policy_reaches_its_heights_and_keeps_its_heading(tmp_path):
    values = HeightSweep(policy="mars_vertical_jump", height_range=(0.9, 3.6), out=tmp_path, **FEW).run()
    assert values["success_rate"] == 1.0 and values["apex_max_m"] > 3.5
    assert values["apex_error_abs_mean_m"] < 0.02  # 0.011 m of 200 jumps
    assert values["turn_abs_mean_deg"] < 15.0  # 4.6 degrees

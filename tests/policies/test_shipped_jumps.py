"""Shipped policies for jumps to places do what their pages tell, on a few nominal jumps."""

from experiments import platform_jump, ring_jump


def test_the_omnidirectional_policy_jumps_all_around(tmp_path):
    args = ring_jump.Args(jumps=16, radius=0.8, record=0, out=tmp_path, device="cpu")
    values = ring_jump.main(args)
    assert values["success_rate"] == 1.0 and values["still_landing_rate"] == 1.0
    assert values["mean_error_m"] < 0.006  # 0.0031 m of 200 jumps


def test_sight_brings_the_robot_onto_a_block_that_a_blind_one_touches(tmp_path):
    flags = {"jumps": 8, "edge": 0.35, "record": 0, "device": "cpu"}
    sighted = platform_jump.main(platform_jump.Args(policy="sighted_jump", out=tmp_path / "sighted", **flags))
    blind = platform_jump.main(platform_jump.Args(policy="horizontal_jump", out=tmp_path / "blind", **flags))
    assert sighted["block_success_rate"] == 1.0 and sighted["platform_success_rate"] == 1.0
    assert blind["block_success_rate"] < 0.7

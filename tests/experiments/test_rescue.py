import pytest

from experiments import rescue


def test_weak_motor_is_identified_from_a_lost_jump(tmp_path, one_thread):
    args = rescue.Args(
        changes=("weak_motor",), modes=("identified",), count=1, nominal=0, timed=0, candidates=8, threads=1,
        out=tmp_path, device="cpu",
    )  # fmt: skip
    values = rescue.main(args)
    assert values["weak_motor_identified_smallest_torque_factor"] == pytest.approx(0.5, abs=0.05)
    assert abs(values["weak_motor_identified_added_mass_kg"]) < 0.2
    assert (tmp_path / "weak_motor" / "identified.rrd").stat().st_size > 10_000

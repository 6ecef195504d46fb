from experiments import reward_gradients


def test_gradients_of_returns_match_differences_in_double_precision(tmp_path, one_thread):
    args = reward_gradients.Args(
        policies=("vertical_jump",), num_envs=10, steps=5, directions=4, out=tmp_path, device="cpu"
    )
    values = reward_gradients.main(args)
    assert values["vertical_jump_windows_above_0.99_rate"] >= 0.8
    assert values["vertical_jump_windows_with_contact_rate"] >= 0.4
    assert values["vertical_jump_rewards_with_faults"] == 0
    assert (tmp_path / "cosines.png").stat().st_size > 10_000

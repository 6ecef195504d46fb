from jumper_warp.utils.assets import assets_folder


def test_assets_folder_is_inside_a_wheel_and_next_to_the_package_in_a_clone(tmp_path):
    package = tmp_path / "jumper_warp"
    package.mkdir()
    assert assets_folder(package) == tmp_path / "assets"
    (package / "assets").mkdir()
    assert assets_folder(package) == package / "assets"

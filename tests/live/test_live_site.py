"""Policies and the page as files for the browser."""

import json

import numpy as np

from jumper_warp.cli.main import main
from jumper_warp.live import site
from jumper_warp.policies.policy import Policy


def test_exported_policy_has_all_weights_and_the_interface(tmp_path):
    main(["export", "walking", "--out", str(tmp_path / "mine")])
    description = json.loads((tmp_path / "mine" / "policy.json").read_text())
    values = np.fromfile(tmp_path / "mine" / "policy.bin", dtype="<f4")
    policy = Policy.load(tmp_path / "mine")  # its manifest covers the new files
    assert description["skill"] == "walk"
    assert description["interface"]["action_scale"] == list(policy.interface.action_scale)
    assert np.array_equal(values, np.concatenate([each.numpy().ravel() for each in policy.tensors().values()]))


def test_page_and_export_name_the_same_observations():
    text = site.files("jumper_warp.live").joinpath("page", "policy.js").read_text()
    terms = text.split("export const TERMS = {")[1].split("}")[0]
    assert {entry.split(":")[0].strip() for entry in terms.split(",") if ":" in entry} == site.TERMS


def test_own_policies_take_the_place_of_their_skills(tmp_path, monkeypatch):
    bundle = tmp_path / "live" / "page" / "dist"
    bundle.mkdir(parents=True)
    (bundle / "index.html").write_text("page")
    monkeypatch.setattr(site, "files", lambda name: tmp_path / "live")
    monkeypatch.setattr(site, "SCENES", {"plain": site.EARTH})
    site.write_page(tmp_path / "out", [Policy.load("walking")])
    scenes = json.loads((tmp_path / "out" / "scenes.json").read_text())
    assert scenes == {"plain": site.EARTH | {"walk": "my_walk"}}
    description = json.loads((tmp_path / "out" / "policies" / "my_walk" / "policy.json").read_text())
    assert description["interface"]["task"] == "velocity-rough"

"""Scripts that make pictures of the documentation, and the policies' pictures."""

from pathlib import Path

from docs import paper_curves, policy_pictures
from jumper_warp.utils.assets import POLICIES

ROOT = Path(__file__).parents[2]


def test_curves_have_a_line_and_a_band_for_each_ablation(tmp_path):
    picture = paper_curves.main(tmp_path / "curves.webp")
    assert picture.read_bytes()[8:12] == b"WEBP" and list(tmp_path.iterdir()) == [picture]


def test_pages_link_every_picture_of_a_policy():
    pages = [*ROOT.glob("docs/**/*.md"), ROOT / "README.md", *POLICIES.glob("*/README.md")]
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    pictures = [path for path in POLICIES.glob("*/*.webp") if path.name != "picture.webp"]
    assert [path for path in pictures if f"{path.parent.name}/{path.name}" not in text] == []
    assert [name for name in policy_pictures.PICTURES if not (POLICIES / f"{name}.webp").is_file()] == []

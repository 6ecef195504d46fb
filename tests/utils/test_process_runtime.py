import os
import subprocess

from jumper_warp.utils.runtime import _git


def test_git_leaves_the_index_of_the_user_alone(tmp_path):
    """Otherwise git of the user fails at the same time, or for good if this one is killed."""
    settings = ("-c", "user.name=x", "-c", "user.email=x")
    (tmp_path / "file").write_text("text")
    for arguments in (("init", "-q"), ("add", "file"), (*settings, "commit", "-q", "-m", "x")):
        subprocess.run(["git", *arguments], cwd=tmp_path, check=True)
    before = (tmp_path / ".git/index").read_bytes()
    os.utime(tmp_path / "file", (1.0e9, 1.0e9))
    assert _git(tmp_path, "status", "--porcelain") == ""
    assert (tmp_path / ".git/index").read_bytes() == before

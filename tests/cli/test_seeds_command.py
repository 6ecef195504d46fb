"""`jumper train --seeds`, and the commands that address a seed of a run."""

import json

import pytest

from cli_helpers import run

SMALL = (
    "--num-envs", "8", "--max-iterations", "1", "--ppo.hidden", "16", "--ppo.epochs", "1", "--ppo.minibatches", "2",
    "--no-tensorboard", "--device", "cpu",
)  # fmt: skip


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Log folder of a training of the seeds 5 and 2, called `try`, with two tags."""
    return tmp_path_factory.mktemp("seeds") / "logs"


@pytest.fixture
def folder(logs, capsys):
    """Folder of the training; the first call trains."""
    if not logs.exists():
        names = ("--run-name", "try", "--tags", "first", "small")
        code, *_ = run(capsys, "train", "vertical-jump", "--seeds", "5", "2", *SMALL, *names, "--log-root", str(logs))
        assert code == 0
    (folder,) = logs.glob("vertical-jump/2*")
    return folder


def test_list_runs_shows_name_seeds_tags_and_commit(folder, logs, capsys):
    (logs / "vertical-jump" / "other").mkdir(exist_ok=True)  # no run
    code, out, err = run(capsys, "list", "runs", "--log-root", str(logs), "--json")
    assert (code, err) == (0, [])
    (entry,) = json.loads(out)
    assert (entry["name"], entry["task"], entry["seeds"]) == ("try", "vertical-jump", [2, 5])
    assert (entry["tags"], entry["iteration"], entry["folder"]) == (["first", "small"], 1, str(folder))
    code, out, _ = run(capsys, "list", "runs", "--log-root", str(logs))
    assert code == 0 and out.splitlines()[1].split()[:2] == ["try", "vertical-jump"]


@pytest.mark.parametrize("seed", [2, 5])
def test_export_takes_the_seed_that_the_source_names(folder, capsys, tmp_path, seed):
    code, _, err = run(capsys, "export", f"{folder}:{seed}", "--out", str(tmp_path / "policy"))
    assert code == 0 and f"{folder}/seed_{seed}: best checkpoint, iteration 1" in err
    config = json.loads((tmp_path / "policy" / "config.json").read_text())
    assert config["train"]["seed"] == seed


def test_resume_continues_the_seeds(folder, logs, capsys):
    args = ("--resume", "latest", "--max-iterations", "2", "--log-root", str(logs), "--device", "cpu")
    code, out, err = run(capsys, "train", "vertical-jump", *args)
    assert (code, out.strip()) == (0, str(folder))
    assert any(line.startswith("seed 5: resumed") for line in err)
    assert {path.name for path in folder.glob("seed_*/checkpoints/*2.pt")} == {"iteration_000002.pt"}

import os
import signal
import socket
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from jumper_warp.cli.main import main
from jumper_warp.cli.sweep import GPUS, SweepCfg, read_sweep, submit, work_on
from jumper_warp.compare.arms import find_arms
from jumper_warp.compare.sweep import ALIVE, RUN, WORKER, TrialReport, open_study, requeue_abandoned
from jumper_warp.compare.sweep_report import PICTURE
from jumper_warp.rl.metrics_file import last_metrics
from jumper_warp.rl.run_folder import INTERRUPTED
from jumper_warp.rl.run_names import seed_folders
from jumper_warp.utils.errors import InputError

optuna = pytest.importorskip("optuna")
FILE = """
task = "vertical-jump"
flags = "--no-randomize --no-noise --history 1 --ppo.hidden 16 --num-envs 8 --max-iterations {iterations} \
--log-interval 1 --save-interval 1 --device cpu"
seeds = [1, 2]
trials = {trials}
startup_trials = 2
metric = "Train/mean_episode_length"
log_root = "{root}"
storage = "{storage}"
{more}
[parameters]
"env.rewards.jump-height.weight" = {{ low = 50.0, high = 400.0, log = true }}
"ppo.epochs" = {{ low = 1, high = 3 }}
"""


def sweep_file(folder, iterations=2, trials=3, storage="sqlite", more=""):
    path = folder / "two_settings.toml"
    path.write_text(FILE.format(root=folder, iterations=iterations, trials=trials, storage=storage, more=more))
    return path


def states(sweep):
    return [trial.state.name for trial in open_study(sweep).get_trials()]


@pytest.mark.parametrize("storage", ["sqlite", "journal"])
def test_a_sweep_trains_its_trials_and_a_later_one_continues(tmp_path, capsys, storage):
    path = sweep_file(tmp_path, trials=1, storage=storage)
    main(["sweep", str(path)])
    sweep = read_sweep(path)
    assert states(sweep) == ["COMPLETE"]
    path = sweep_file(tmp_path, trials=2, storage=storage)
    main(["sweep", str(path)])
    assert states(sweep) == ["COMPLETE"] * 2
    page = (sweep.folder / "sweep.md").read_text()
    assert all(f"| trial_00{number} | complete |" in page for number in range(2))
    assert (sweep.folder / PICTURE).stat().st_size > 10_000
    arms = find_arms([sweep.folder / "vertical-jump"])
    assert [(arm.name, arm.seeds) for arm in arms] == [(f"trial_00{number}", [1, 2]) for number in range(2)]
    trained = [arm.settings["env.rewards.jump-height.weight"] for arm in arms]
    chosen = [trial.params["env.rewards.jump-height.weight"] for trial in open_study(sweep).get_trials()]
    assert trained == pytest.approx(chosen)
    assert any(f"--env.rewards.jump-height.weight {value} --ppo.epochs" in page for value in chosen)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[1, 2]", "[1, 3]", r"seeds was \[1, 2\], got \[1, 3\]"),
        ("--num-envs 8", "--num-envs 16", "flags was"),
        ("high = 400.0", "high = 500.0", "parameters was"),
    ],
)
def test_trials_of_another_setting_do_not_mix_in_a_sweep(tmp_path, old, new, message):
    path = sweep_file(tmp_path)
    open_study(read_sweep(path))
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=message):
        open_study(read_sweep(path))


def test_the_value_of_a_trial_is_the_mean_of_its_seeds(tmp_path):
    path = sweep_file(tmp_path, trials=1)
    work_on(path)
    sweep = read_sweep(path)
    (trial,) = open_study(sweep).get_trials()
    (run,) = (sweep.folder / "vertical-jump").glob("*/")
    values = [last_metrics(folder)["Train/mean_episode_length"] for folder in seed_folders(run).values()]
    assert trial.value == pytest.approx(sum(values) / 2)
    assert list(trial.intermediate_values) == [1, 2]


def test_of_two_workers_one_is_killed_and_nothing_is_lost(tmp_path):
    """The killed worker's trial is continued from its checkpoint by the other one."""
    pytest.importorskip("submitit")
    path = sweep_file(tmp_path, iterations=15, trials=2, more="pruning = false")
    sweep = read_sweep(path)
    jobs = submit(SweepCfg(path, workers=2, slurm=("timeout_min=10",)), sweep.folder)
    killed = None
    for _ in range(1200):
        running = open_study(sweep).get_trials(states=(optuna.trial.TrialState.RUNNING,))
        begun = [trial for trial in running if len(trial.intermediate_values) > 2]
        if begun and killed is None:
            killed = begun[0]
            os.kill(int(killed.user_attrs[WORKER].partition(":")[2]), signal.SIGKILL)
        if states(sweep).count("COMPLETE") == 2:
            break
        time.sleep(0.5)
    for job in jobs:
        job.wait()
    trials = open_study(sweep).get_trials()
    assert sorted(trial.state.name for trial in trials) == ["COMPLETE", "COMPLETE", "FAIL"]
    (again,) = [t for t in trials if t.user_attrs[RUN] == killed.user_attrs[RUN] and t.number != killed.number]
    assert again.params == killed.params
    assert min(again.intermediate_values) > 1  # it did not begin from scratch
    assert len(list((sweep.folder / "vertical-jump").glob("*/"))) == 2


def test_a_trial_of_a_killed_worker_is_queued_before_its_parent_asks_for_its_end(tmp_path):
    sweep = read_sweep(sweep_file(tmp_path))
    study = open_study(sweep)
    with subprocess.Popen(["sleep", "100"]) as worker:
        trial = study.ask(sweep.distributions())
        for name, value in ((WORKER, f"{socket.gethostname()}:{worker.pid}"), (ALIVE, 0.0), (RUN, "trial_000")):
            trial.set_user_attr(name, value)
        requeue_abandoned(study, grace=0.0)
        assert states(sweep) == ["RUNNING"]
        worker.kill()
        os.waitid(os.P_PID, worker.pid, os.WEXITED | os.WNOWAIT)  # until it is a zombie
        requeue_abandoned(study, grace=0.0)
        assert states(sweep) == ["FAIL", "WAITING"]


def test_a_trial_of_another_host_is_queued_after_the_time_without_a_sign(tmp_path):
    sweep = read_sweep(sweep_file(tmp_path))
    study = open_study(sweep)
    for sign in (time.time() - 100.0, time.time()):
        trial = study.ask(sweep.distributions())
        for name, value in ((WORKER, "elsewhere:1"), (ALIVE, sign), (RUN, f"trial_{trial.number:03d}")):
            trial.set_user_attr(name, value)
    requeue_abandoned(study, grace=50.0)
    assert states(sweep) == ["FAIL", "RUNNING", "WAITING"]
    assert study.ask(sweep.distributions()).user_attrs[RUN] == "trial_000"


def test_pruning_ends_a_trial_below_the_median(tmp_path):
    path = sweep_file(tmp_path, trials=4, more='direction = "minimize"')
    sweep = read_sweep(path)
    study = open_study(sweep)
    for _ in range(3):  # finished trials with values that no training reaches
        trial = study.ask(sweep.distributions())
        trial.set_user_attr(RUN, f"trial_{trial.number:03d}")
        for iteration in (1, 2):
            trial.report(0.1, iteration)
        study.tell(trial, 0.1)
    work_on(path)
    last = open_study(sweep).get_trials()[-1]
    assert last.state.name == "PRUNED"
    assert list(last.intermediate_values) == [1]


@pytest.mark.parametrize(
    ("name", "choices", "message"),
    [("ppo.epochs", [-1, 1], "epochs must be"), ("ppo.epochs", ["many", 1], ": invalid flags")],
)
def test_a_trial_that_fails_is_pruned_and_the_sweep_continues(tmp_path, capsys, name, choices, message):
    path = sweep_file(tmp_path, trials=4)
    head, _, _ = path.read_text().partition("[parameters]")
    path.write_text(f'{head}[parameters]\n"{name}" = {{ choices = {choices} }}\n')
    main(["sweep", str(path)])
    assert set(states(read_sweep(path))) == {"COMPLETE", "PRUNED"}
    assert message in capsys.readouterr().out


def test_a_frozen_or_undefined_seed_does_not_stop_the_reports(tmp_path):
    sweep = read_sweep(sweep_file(tmp_path))
    trial = open_study(sweep).ask(sweep.distributions())
    report = TrialReport(trial, sweep)
    for iteration, values in ((1, (2.0, 4.0)), (2, (2.0, 8.0)), (3, (2.0, float("nan"))), (4, (float("nan"),) * 2)):
        pairs = zip((1, iteration), values, strict=True)  # the first seed is frozen at iteration 1
        cfg = SimpleNamespace(log_interval=1)
        runs = [SimpleNamespace(iteration=i, cfg=cfg, metrics={sweep.metric: value}) for i, value in pairs]
        report.after_iteration(runs)
    (saved,) = open_study(sweep).get_trials()
    assert saved.intermediate_values == {1: 3.0, 2: 5.0, 3: 2.0}


@pytest.mark.parametrize(("code", "state"), [(INTERRUPTED, "RUNNING"), ("jumper: no finite weights", "PRUNED")])
def test_a_trial_of_failed_seeds_is_pruned_but_not_an_interrupted_one(tmp_path, monkeypatch, code, state):
    def end(*_):
        raise SystemExit(code)

    monkeypatch.setattr("jumper_warp.compare.sweep.train_arm", end)
    path = sweep_file(tmp_path, trials=1)
    with pytest.raises(SystemExit) if code == INTERRUPTED else nullcontext():
        work_on(path)
    assert states(read_sweep(path)) == [state]


def test_a_boolean_choice_is_a_flag_or_its_opposite(tmp_path):
    arguments = read_sweep(sweep_file(tmp_path)).arguments({"noise": True, "ppo.normalise-value": False}, "run")
    assert arguments[arguments.index("cpu") + 1 :][:3] == ["--noise", "--ppo.no-normalise-value", "--seeds"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("{ low = 1, high = 3 }", "{ low = nan, high = 3.0 }", "ppo.epochs must be finite"),
        ("ppo.epochs", "seeds", "sets --seeds"),
        ("--num-envs 8", "--run_name=x", "sets --run-name"),
        ("startup_trials = 2", "grace = nan", "grace must be"),
        ("startup_trials = 2", "nothing = 1", "nothing"),
        ("startup_trials = 2", 'name = "../up"', "name may contain"),
        ("sqlite", "sqlite:////none/none.db", "unable to open"),
        ("Train/mean_episode_length", "Train/mean_episode", "metric must name a logged metric, such as"),
    ],
)
def test_a_setting_of_a_sweep_that_cannot_be_used_is_named(tmp_path, capsys, old, new, message):
    path = sweep_file(tmp_path, iterations=1, trials=2)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(SystemExit):
        main(["sweep", str(path)])
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("gpus", [None, "", "3"])
def test_a_worker_sees_the_gpus_of_its_parent_and_does_not_ignore_ctrl_c(tmp_path, monkeypatch, gpus):
    """As it would in a script's `jumper sweep FILE --workers 2 &`; submitit hides all GPUs."""
    pytest.importorskip("submitit")
    (tmp_path / "seen_by_worker.py").write_text(f"""
import os, pathlib, signal
seen = [os.environ.get("CUDA_VISIBLE_DEVICES"), signal.getsignal(signal.SIGINT) == signal.SIG_IGN]
pathlib.Path("{tmp_path}/seen").write_text(str(seen))
raise SystemExit
""")
    monkeypatch.delenv(GPUS, raising=False)
    if gpus is not None:
        monkeypatch.setenv(GPUS, gpus)
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        (job,) = submit(SweepCfg(sweep_file(tmp_path, more='modules = ["seen_by_worker.py"]')), tmp_path)
        job.wait()
    finally:
        signal.signal(signal.SIGINT, previous)
    assert (tmp_path / "seen").read_text() == str([gpus, False])


@pytest.mark.parametrize("storage", ["sqlite", "journal"])
def test_workers_that_start_together_share_one_new_study(tmp_path, storage):
    sweep = read_sweep(sweep_file(tmp_path, storage=storage))
    with ThreadPoolExecutor(6) as pool:
        studies = list(pool.map(lambda worker: open_study(sweep, worker), range(6)))
    assert len({study._study_id for study in studies}) == 1

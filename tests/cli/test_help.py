from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import pytest
import tyro

from cli_helpers import run
from jumper_warp.cli.flags import list_flags
from jumper_warp.cli.main import parse
from jumper_warp.cli.train import SHORT_HELP, parse_train
from jumper_warp.registry import TASKS, make_task
from jumper_warp.utils.errors import InputError


@dataclass(frozen=True)
class Engine:
    power: float = 2.5  # [kW] Largest power
    valves: tuple[int, int] = (2, 2)

    def __post_init__(self):
        if min(self.valves) < 1:
            raise InputError(f"valves must be at least 1, got {min(self.valves)}")


@dataclass(frozen=True)
class Motor(Engine):
    power: float = 4.0


@dataclass(frozen=True)
class Car:
    """Drive a car."""

    road: tyro.conf.Positional[str]  # Name of the road
    seed: int = 3
    """Seed of the traffic. A second sentence follows."""
    fuel: Literal["petrol", "gas"] = "petrol"
    lights: bool = True  # Switch the lights on
    map: Path | None = None  # Map of the roads (default: none)
    engine: Engine = field(default_factory=Engine)  # Settings of the engine
    radio: Annotated[Engine, tyro.conf.arg(name="")] = Engine(power=0.1)
    hidden: tyro.conf.Suppress[int] = 0


def parse_car(*args):
    """Return the car that `jumper drive` makes of arguments."""
    return parse(Car, "drive", args)


def page(capsys, *args):
    """Return the help that `jumper drive` prints."""
    with pytest.raises(SystemExit) as end:
        parse_car(*args)
    assert end.value.code == 0
    return capsys.readouterr().out


def test_flags_have_names_types_defaults_and_descriptions():
    flags = {flag.name: flag for flag in list_flags(Car)}
    assert list(flags) == ["ROAD", "seed", "fuel", "lights", "map", "engine.power", "engine.valves", "power", "valves"]
    assert flags["lights"].options == ["--lights", "--no-lights"] and flags["ROAD"].options == []
    assert flags["seed"].about == "Seed of the traffic. A second sentence follows."
    assert (flags["ROAD"].about, flags["engine.power"].about) == ("Name of the road", "[kW] Largest power")
    assert (flags["engine.power"].default, flags["power"].default, flags["map"].default) == (2.5, 0.1, None)


def test_field_with_a_new_default_in_a_subclass_keeps_its_description():
    assert next((flag.default, flag.about) for flag in list_flags(Motor)) == (4.0, "[kW] Largest power")


def test_flags_of_an_instance_have_its_values_as_defaults():
    flags = {flag.name: flag.default for flag in list_flags(Car("A1", seed=5, engine=Engine(power=9.0)))}
    assert (flags["ROAD"], flags["seed"], flags["engine.power"]) == ("A1", 5, 9.0)


def test_help_has_first_sentences_and_help_all_has_all(capsys):
    out = " ".join(page(capsys, "--help").replace("│", "").split())
    assert "ROAD Name of the road (required)" in out
    assert "--seed INT Seed of the traffic (default: 3)" in out and "(default: none) --" in out
    assert "--help GROUP prints a group of flags: engine." in out
    assert "Seed of the traffic. A second sentence follows. (default: 3)" in " ".join(
        page(capsys, "--help-all").split()
    )


def test_help_of_a_group_has_its_flags_only(capsys):
    out = page(capsys, "--help", "engine")
    assert "--engine.power FLOAT" in out and "--engine.valves INT INT" in out and "--seed" not in out


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["A1", "--sed", "3"], "--seed INT"),
        (["A1", "--seed", "x"], "Error parsing --seed"),
        (["A1", "--engine.valves", "2"], "--engine.valves"),
        (["A1", "--fuel", "wood"], "invalid choice 'wood'"),
        (["A1", "A2"], "Unrecognized options: A2"),
        (["--seed", "3"], "Name of the road"),
    ],
)
def test_invalid_arguments_are_reported_with_the_flag(args, message, capsys):
    with pytest.raises(SystemExit) as end:
        parse_car(*args)
    assert end.value.code == 2 and message in capsys.readouterr().err


def test_error_of_a_dataclass_is_an_input_error_without_tyros_box(capsys):
    with pytest.raises(InputError, match="valves must be at least 1, got 0"):
        parse_car("A1", "--engine.valves", "0", "2")
    assert not capsys.readouterr().err


def test_arguments_set_nested_and_negated_flags():
    car = parse_car("A1", "--engine.power", "3", "--no-lights", "--power", "0.2")
    assert (car.road, car.engine.power, car.lights, car.radio.power) == ("A1", 3.0, False, 0.2)


# ---------------------------------------------------------------------- jumper


@pytest.mark.parametrize("task", [[], ["vertical-jump"], ["velocity-rough"]], ids=" ".join)
def test_help_of_train_fits_60_lines(capsys, monkeypatch, task):
    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = run(capsys, "train", *task, "--help")
    assert code == 0 and out.count("\n") <= 60
    assert all(f" --{name}" in out for name in SHORT_HELP)


def test_help_all_has_each_flag_of_a_task(capsys):
    _, out, _ = run(capsys, "train", "vertical-jump", "--help-all")
    assert all(name in out for name in ("--ppo.max-grad-norm", "--env.rewards.jump-height.weight", "--robot"))


def test_help_of_a_group_of_a_task(capsys):
    code, out, _ = run(capsys, "train", "vertical-jump", "--help", "env.rewards")
    assert code == 0 and "--env.rewards.jump-height.weight" in out and "--env.reset" not in out and "--ppo" not in out


@pytest.mark.parametrize("task", [name for name, entry in TASKS.items() if entry.presets])
def test_preset_sets_and_prints_flags_that_other_flags_do_not_override(task, capsys):
    recipe, _ = parse_train([task.replace("-", "_"), "--num-envs", "8", "--preset", "laptop", "--noise"])
    assert (recipe.train.num_envs, recipe.randomize, recipe.noise) == (8, False, True)
    line = capsys.readouterr().err
    assert line.startswith("preset laptop: --no-randomize --history 1 --ppo.hidden 128 64 64 --")
    assert "--num-envs" not in line and "--no-noise" not in line
    assert recipe.train.ppo.hidden == (128, 64, 64) and recipe.train.ppo.desired_kl == 0.02
    widths = [max(end for _, end in each.layout("actor").values()) for each in (recipe.task, make_task(task))]
    assert widths[0] < widths[1]  # one step of observations

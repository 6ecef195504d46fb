"""Numbers that no robot and no machine has are refused in one line that names the setting and its limits."""

import dataclasses
import math
import sys

import pytest

from cli_helpers import run
from jumper_warp.identification.motions import NoiseLevels
from jumper_warp.registry import make_task
from jumper_warp.rl.cfg import PPO_BOUNDS, PpoCfg, TrainCfg
from jumper_warp.robot.motors import MOTOR_BOUNDS, FilterCfg, LimitsCfg, jumping_motors, vertical_jump_filter
from jumper_warp.robot.overlay import RANDOMIZED, RANGES, RobotOverlay
from jumper_warp.robot.values import RobotValues
from jumper_warp.sim.simulation import Simulation
from jumper_warp.tasks.cfg import TASK_BOUNDS
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.terms import OBSERVATION_BOUNDS
from jumper_warp.utils.errors import InputError
from squat_hold import Args as SquatArgs
from support.scripts import parse_flags

IMPOSSIBLE = (math.nan, math.inf, -math.inf, 1e30, -1e30)
NOMINAL = vars(RobotValues.nominal(1))
TASK = make_task("vertical-jump")
MOTOR = jumping_motors().lateral
FILTER = vertical_jump_filter()
SETTINGS = {  # by setting: a function that makes a configuration with a value of it
    **{f"overlay {name}": lambda x, name=name: RobotOverlay({name: NOMINAL[name].shape[1] * (x,)}) for name in RANGES},
    **{f"overlay range {name}": lambda x, name=name: RobotOverlay({}, {name: (x, x)}) for name in RANDOMIZED},
    **{f"range {name}": lambda x, name=name: RandomizationCfg(**{name: (x, x)}) for name in RANDOMIZED},
    **{f"motor {name}": lambda x, name=name: dataclasses.replace(MOTOR, **{name: x}) for name in MOTOR_BOUNDS},
    **{f"limit {name}": lambda x, name=name: LimitsCfg(**vars(FILTER.sum) | {name: x}) for name in vars(FILTER.sum)},
    "filter horizon": lambda x: FilterCfg(**vars(FILTER) | {"horizon": x}),
    "filter speed_floor": lambda x: FilterCfg(**vars(FILTER) | {"speed_floor": x}),
    **{f"task {name}": lambda x, name=name: dataclasses.replace(TASK, **{name: x})
       for name in TASK_BOUNDS if name != "action_scale"},
    "task action_scale": lambda x: dataclasses.replace(TASK, action_scale=(x, x)),
    "task gravity": lambda x: dataclasses.replace(TASK, gravity=x),
    **{f"observation {name}": lambda x, name=name: TASK.observations.actor[0].replace(**{name: x})
       for name in OBSERVATION_BOUNDS},
    "reward weight": lambda x: TASK.rewards[0].replace(weight=x),
    **{f"sensor {name}": lambda x, name=name: NoiseLevels(**{name: x}).check() for name in vars(NoiseLevels())},
    **{f"ppo {name}": lambda x, name=name: PpoCfg(**{name: x}) for name in PPO_BOUNDS},
    "simulation dt": lambda x: Simulation(1, dt=x, visuals=False, device="cpu"),
    "simulation friction": lambda x: Simulation(1, friction=x, visuals=False, device="cpu"),
    "simulation gravity": lambda x: Simulation(1, gravity=x, visuals=False, device="cpu"),
}  # fmt: skip


@pytest.mark.parametrize("setting", SETTINGS)
def test_impossible_number_is_refused_in_one_line(setting):
    for value in IMPOSSIBLE:
        with pytest.raises(InputError) as refusal:
            SETTINGS[setting](value)
        message = str(refusal.value)
        assert "\n" not in message and any(word in message for word in (setting.split()[-1], "limit", "zones"))


@pytest.mark.parametrize(
    "change",
    [{"num_envs": 0}, {"num_envs": 2**20 + 1}, {"num_envs": 10**400}, {"max_iterations": 10**20}, {"threads": 10**20},
     {"max_checkpoints": 0}, {"seed": 10**400}, {"max_seconds": math.nan}],
)  # fmt: skip
def test_training_has_a_number_of_worlds_and_iterations_that_a_machine_can_hold(change):
    with pytest.raises(InputError, match=f"{next(iter(change))} must be"):
        TrainCfg(**change)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ("evaluate vertical_jump --num-jumps 20000000", "--num-jumps must be at most 100000, got 20000000"),
        ("evaluate attitude --num-turns 100001", "--num-turns must be at most 100000"),
        ("evaluate vertical_jump --threads NINES", "--threads must be at most 2147483648, got 9999"),
        ("train vertical-jump --threads NINES", "threads must be a whole number of 1 to 1024, got 9999"),
        ("train vertical-jump --env.motors.lateral.kp 1e30", "--env.motors.lateral.kp must be at most 2147483648"),
        ("train vertical-jump --env.motors.lateral.kp 1e5", "motor kp must be in 0 to 10000 N m/rad, got 100000.0"),
        ("sysid excite --seconds 1e9", "--seconds must be at most 3600, got 1000000000.0"),
        ("sysid excite --noise.angle nan", "--noise.angle must be a finite number, got nan"),
        (
            "train velocity-flat --env.levels.0.resampling-time-range nan 1",
            "resampling_time_range must be (lower, upper)",
        ),
        ("train vertical-jump --env.terminations.too-long.steps -1", "'steps' must be 0 or more, infinite for never"),
    ],
)
def test_flag_beyond_what_a_machine_can_hold_is_refused(args, message, capsys):
    code, _, err = run(capsys, *args.replace("NINES", "9" * 20).split())
    assert code == 2 and len(err) == 1 and message in err[0]


def test_flag_of_a_duration_may_be_infinite(capsys):
    args = "train vertical-jump --env.terminations.too-long.steps inf --init-policy /none --num-envs 2 --device cpu"
    assert run(capsys, *args.split())[2] == ["jumper: /none: no such folder (policy)"]


def test_flag_of_an_experiment_is_bounded_likewise(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["squat_hold.py", "--num-squats", "20000000"])
    with pytest.raises(InputError, match="--num-squats must be at most 100000, got 20000000"):
        parse_flags(SquatArgs)

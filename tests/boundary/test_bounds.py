"""Numbers that no robot and no machine has are refused in one line that names the setting and its limits."""

import dataclasses
import math

import pytest

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
    ("change", "message"),
    [
        *(({name: value}, f"{name} must be") for name, value in (
            ("num_envs", 0), ("num_envs", 2**20 + 1), ("num_envs", 10**400), ("max_iterations", 10**20),
            ("threads", 10**20), ("max_checkpoints", 0), ("seed", 10**400), ("seed", -1), ("max_seconds", math.nan))),
        ({"resume": ""}, "resume is empty"),
        ({"init_policy": ""}, "init_policy is empty"), ({"seeds": (1, 1)}, "seeds must be distinct"),
        ({"seeds": (1, -1)}, "seed must be in"),
        ({"run_name": "a/b"}, "task, run_name and tags"), ({"tags": ("",)}, "task, run_name and tags"),
    ],
)  # fmt: skip
def test_settings_of_a_training_are_refused_by_name(change, message):
    with pytest.raises(InputError, match=message):
        TrainCfg(**change)

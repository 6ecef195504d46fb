"""Several policies on one robot under evaluation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.run import EvaluationArgs, Run, conditions_of
from jumper_warp.policies.skills import SkillNames, SkillPolicies


class SkillRun(Run):
    """Opens the policies of one robot, follows it as often as wanted, and reports."""

    def __init__(self, names: SkillNames | None = None) -> None:
        """Open policies; call `prepare` before anything else. Raises PolicyError or CheckpointError: see there."""
        super().__init__()
        self.skills = SkillPolicies(names)

    @classmethod
    def of(cls, name: str, args: EvaluationArgs, names: SkillNames) -> SkillRun:
        """Return the run of an experiment, prepared. Raises PolicyError, CheckpointError, or InputError: no device."""
        run = cls(names)
        run.prepare(name, conditions_of(args), args.out, record=args.record)
        return run

    def actor(self, env: Env) -> Callable[[torch.Tensor], torch.Tensor]:
        """Return the actions of all skills."""
        return lambda obs: self.skills.act(env)

    def env(self, count: int, **scene: Any) -> Env:
        """Return the environment of the robot; scene: more settings of `Env`."""
        return self.skills.env(count, self.conditions, **scene)

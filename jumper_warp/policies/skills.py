"""Several policies on one robot: walking and jumps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from jumper_warp.policies.conditions import Conditions
from jumper_warp.policies.restore import task_of_policy
from jumper_warp.policies.runs import open_policy
from jumper_warp.policies.spec import PolicyError
from jumper_warp.tasks.cfg import Handover, TaskCfg
from jumper_warp.tasks.switching import skills_and_handovers
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env

WALK, JUMP_UP, JUMP_TO = range(3)
"""Indices of the skills in the environment."""


@dataclass(frozen=True)
class SkillNames:
    """Policies of one robot, by name or folder."""

    walk: str = "walking_flat"
    """Follows velocities."""
    jump_up: str = "vertical_jump"
    """Jumps to a height."""
    jump_to: str = "horizontal_jump"
    """Jumps to a place."""


class SkillPolicies:
    """Opens the policies of one robot, makes its environment, and acts in it."""

    def __init__(self, names: SkillNames | None = None) -> None:
        """Open policies. Raises PolicyError or CheckpointError: one cannot be used, or is of another kind of task."""
        self.names = SkillNames() if names is None else names
        sources = (self.names.walk, self.names.jump_up, self.names.jump_to)
        self.policies = [open_policy(source) for source in sources]
        self.tasks = [task_of_policy(policy) for policy in self.policies]
        for task, kinds in zip(
            self.tasks, (("velocity",), ("apex_height",), ("landing_position", "omnidirectional")), strict=True
        ):
            if task.evaluation_suite not in kinds:
                raise PolicyError(
                    f"this needs a policy that is evaluated by {' or '.join(kinds)}, got one of {task.name}"
                )
        self.skills, self.handovers = self._in(Conditions())

    def _in(self, conditions: Conditions) -> tuple[list[TaskCfg], list[Handover]]:
        """Return the tasks in some conditions and their handovers. Raises PolicyError: these are no such tasks."""
        walk, *jumps = (conditions.applied(task) for task in self.tasks)
        try:
            return skills_and_handovers(walk, tuple(jumps))
        except InputError as error:
            raise PolicyError(str(error)) from error

    def env(self, count: int, conditions: Conditions, **scene: Any) -> Env:
        """Return an environment of robots that walk first; scene: more settings of `Env`. Raises as `Env`."""
        from jumper_warp.envs.env import Env

        self.skills, self.handovers = self._in(conditions)
        settings = conditions.env_settings({})
        env = Env(self.skills, count, skill=WALK, handovers=self.handovers, **settings, **scene)
        for policy in self.policies:
            policy.to(env.device)
        return env

    def act(self, env: Env) -> torch.Tensor:
        """Return every skill's actions for its observations, (skills, num_envs, 12); nothing waits for the device."""
        return torch.stack(
            [policy.act(skill.obs["actor"]) for policy, skill in zip(self.policies, env.skills, strict=True)]
        )

"""Policies for walking and jumps, between which the robots of one environment can switch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from jumper_warp.evaluation.conditions import Conditions, shared_robot
from jumper_warp.policies.spec import PolicyError
from jumper_warp.tasks.cfg import Handover, TaskCfg
from jumper_warp.tasks.jump.evaluation import HeightEvaluation, PlaceEvaluation
from jumper_warp.tasks.switching import skills_and_handovers
from jumper_warp.tasks.velocity.cfg import VelocityEvaluation
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    import torch

    from jumper_warp.envs.env import Env

WALK, JUMP_UP, JUMP_TO = range(3)  # Indices of the skills: walking, jump to a height, jump to a position


@dataclass(frozen=True)
class SkillNames:
    """Names or folders of three policies: for walking, for vertical jumps and for horizontal jumps."""

    walk: str = "walking_flat"  # Policy that follows commanded velocities
    jump_up: str = "vertical_jump"  # Policy that jumps to a commanded height
    jump_to: str = "horizontal_jump"  # Policy that jumps to a commanded position


class SkillPolicies:
    """Policies for walking, vertical and horizontal jumps (WALK, JUMP_UP, JUMP_TO), with their environment (`env`).

    sources, policies, tasks: name, policy and task of each; skills, handovers: tasks in the conditions of the last
    `env`, and the conditions for a change of the skill.
    """

    def __init__(self, names: SkillNames | None = None) -> None:
        """Load the policies (default names: `SkillNames()`).

        Raises PolicyError or CheckpointError: one cannot be used, or is for another kind of skill.
        """
        from jumper_warp.policies.policy import Policy

        self.names = SkillNames() if names is None else names
        self.sources = (self.names.walk, self.names.jump_up, self.names.jump_to)
        self.policies = [Policy.load(source) for source in self.sources]
        self.recipes = [policy.recipe() for policy in self.policies]
        self.tasks = [recipe.tested_task(randomize=False) for recipe in self.recipes]
        for task, kind in zip(self.tasks, (VelocityEvaluation, HeightEvaluation, PlaceEvaluation), strict=True):
            if not isinstance(task.evaluation, kind):
                raise PolicyError(f"expected a policy of a task with a {kind.__name__}, got one of {task.name}")
        self.skills, self.handovers = self._skills_and_handovers(Conditions())

    def _skills_and_handovers(self, conditions: Conditions) -> tuple[list[TaskCfg], list[Handover]]:
        """Return the skills' tasks in test conditions, and the handovers between skills.

        Raises PolicyError: the tasks do not fit.
        """
        walk, *jumps = (conditions.applied(task) for task in self.tasks)
        try:
            return skills_and_handovers(walk, tuple(jumps))
        except InputError as error:
            raise PolicyError(str(error)) from error

    def env(self, count: int, conditions: Conditions, **scene: Any) -> Env:
        """Return an environment of `count` robots that start with WALK, and move the policies to its device.

        The robot has the overlay (changed parameters) of the policies' training. scene: further arguments of `Env`.
        Raises PolicyError: policies were trained with different overlays.
        """
        from jumper_warp.envs.env import Env

        self.skills, self.handovers = self._skills_and_handovers(conditions)
        robots = {source: recipe.robot for source, recipe in zip(self.sources, self.recipes, strict=True)}
        settings = conditions.env_settings(shared_robot(robots, conditions))
        env = Env(self.skills, count, skill=WALK, handovers=self.handovers, **settings, **scene)
        for policy in self.policies:
            policy.to(env.device)
        return env

    def act(self, env: Env) -> torch.Tensor:
        """Return every skill's action for its observation, (skills, num_envs, 12), without host synchronisation."""
        import torch

        return torch.stack(
            [policy.act(skill.obs["actor"]) for policy, skill in zip(self.policies, env.skills, strict=True)]
        )

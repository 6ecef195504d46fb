"""A task's settings as flags of the command line: numbers by name, functions left as the task has them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from jumper_warp.envs.randomization import RandomizationCfg
from jumper_warp.robot.motors import FilterCfg, MotorCfg
from jumper_warp.tasks.cfg import GroundCfg, Level, NoiseCfg, Pair, ResetCfg, Rule, TaskCfg, Term


@dataclass(frozen=True)
class TaskFlags:
    """Settings of a task. See `jumper_warp.tasks.cfg.TaskCfg`."""

    weights: dict[str, float]
    """Weight of each reward term; 0 turns it off."""
    term_params: dict[str, tuple[float, ...]]
    """Parameters of each reward term."""
    rule_params: dict[str, tuple[float, ...]]
    """Parameters of each end of an episode."""
    levels: tuple[Level, ...]
    """Curriculum, easiest level first."""
    motors: MotorCfg
    command_filter: FilterCfg
    action_scale: Pair
    """[deg] Lateral and transversal."""
    reset: ResetCfg
    ground: GroundCfg
    noise: NoiseCfg
    randomization: RandomizationCfg
    takeoff_speed: float
    """[m/s] Upward speed without contact that begins a flight."""
    contact_force: float
    """[N] Above it a paw counts as in contact."""
    near: float
    """[m] Error up to which a landed jump is a success."""
    games: int
    """Successes in a row that raise the level."""

    @classmethod
    def of(cls, task: TaskCfg) -> TaskFlags:
        """Return the settings of a task. Functions without parameters have no flag for them."""
        names = {spec.name for spec in dataclasses.fields(cls)} & {spec.name for spec in dataclasses.fields(task)}
        return cls(
            weights={flag_name(term): term.weight for term in task.terms},
            term_params={flag_name(term): term.params for term in task.terms if term.params},
            rule_params={flag_name(rule): rule.params for rule in task.terminations if rule.params},
            **{name: getattr(task, name) for name in names},
        )

    def apply(self, task: TaskCfg) -> TaskCfg:
        """Return the task with these settings. Raises ValueError as `TaskCfg` does."""
        shared = {spec.name for spec in dataclasses.fields(self)} & {spec.name for spec in dataclasses.fields(task)}
        terms = tuple(
            dataclasses.replace(
                term,
                weight=self.weights[flag_name(term)],
                params=self.term_params.get(flag_name(term), term.params),
            )
            for term in task.terms
        )
        rules = tuple(
            dataclasses.replace(rule, params=self.rule_params.get(flag_name(rule), rule.params)) for rule in task.rules
        )
        return dataclasses.replace(task, terms=terms, rules=rules, **{name: getattr(self, name) for name in shared})


def flag_name(row: Term | Rule) -> str:
    """Return the name of a row of a table as a flag has it."""
    return row.name.replace("_", "-")

"""`jumper completion SHELL`: print the script that completes commands, tasks, policies and flags in a shell.

    jumper completion bash > ~/.local/share/bash-completion/completions/jumper

The names are those of today's package; flags of a single task, --env, are left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Literal, get_args, get_origin

import tyro

from jumper_warp.cli.flags import list_flags
from jumper_warp.cli.main import COMMANDS, TASK_MODULE, parse

SCRIPT = """\
_jumper() {{
    local cur=${{COMP_WORDS[COMP_CWORD]}} prev=${{COMP_WORDS[COMP_CWORD-1]}} words=
    if [[ $COMP_CWORD == 1 ]]; then
        words="{commands}"
    elif [[ $cur == -* ]]; then
        case ${{COMP_WORDS[1]}} in
{flags}
        esac
    elif [[ $prev == -* ]]; then
        case $prev in
{values}
        esac
    elif [[ $COMP_CWORD == 2 ]]; then
        case ${{COMP_WORDS[1]}} in
{names}
        esac
    fi
    COMPREPLY=($(compgen -W "$words" -- "$cur"))
}}
complete -o default -F _jumper jumper
"""
ZSH = "autoload -U +X compinit && compinit\nautoload -U +X bashcompinit && bashcompinit\n"


@dataclass(frozen=True)
class CompletionCfg:
    """Print the script that completes commands, tasks, policies and flags in a shell.

    bash: jumper completion bash > ~/.local/share/bash-completion/completions/jumper
    zsh: jumper completion zsh >> ~/.zshrc
    """

    shell: tyro.conf.Positional[Literal["bash", "zsh"]]  # bash or zsh


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Print the completion script of a shell; modules: loaded by --task-module, with their tasks registered."""
    cfg = parse(CompletionCfg, "completion", args)
    from jumper_warp.registry import task_names
    from jumper_warp.utils.assets import policy_tasks

    tasks = task_names()
    policies = tuple(policy_tasks())
    names: dict[str, Iterable[str]] = dict.fromkeys(("play", "drive", "evaluate", "finetune", "export"), policies)
    names |= {"train": tasks, "info": (*tasks, *policies), "sysid": ("fit", "excite", "actuator")}
    names["completion"] = ("bash", "zsh")
    flags = {command: [flag for cfg in settings_of(command) for flag in list_flags(cfg)] for command in COMMANDS}
    common = (TASK_MODULE, "--help", "--help-all")
    options = {c: dict.fromkeys([*(o for flag in each for o in flag.options), *common]) for c, each in flags.items()}
    values = {
        f"--{flag.name}": map(str, filter(None, get_args(flag.kind)))
        for each in flags.values()
        for flag in each
        if get_origin(flag.kind) is Literal
    }
    script = SCRIPT.format(commands=" ".join(COMMANDS), flags=cases(options), values=cases(values), names=cases(names))
    print((ZSH if cfg.shell == "zsh" else "") + script, end="")


def settings_of(command: str) -> list[Any]:
    """Return the dataclasses, or instances of them, whose fields are a command's flags for all kinds of tasks."""
    from jumper_warp.cli import doctor, drive, export, info, list, sysid, train, watch
    from jumper_warp.evaluation.commands import DumpCfg, EvaluateCfg, PlayCfg, ScriptCfg
    from jumper_warp.evaluation.evaluations import default_flags, stock_evaluations
    from jumper_warp.evaluation.finetuning_cfg import FinetuneArgs

    stock = stock_evaluations().values()
    return {
        "train": [train.TrainArgs],
        "watch": [watch.WatchArgs],
        "finetune": [FinetuneArgs],
        "play": [*(PlayCfg(default_flags(each, "play")) for each in stock), ScriptCfg, DumpCfg],
        "drive": [drive.DriveCfg],
        "evaluate": [EvaluateCfg(default_flags(each, "evaluate")) for each in stock],
        "export": [export.ExportCfg],
        "sysid": [sysid.SysidCfg, sysid.ExciteCfg, sysid.ActuatorCfg],
        "list": [list.ListCfg],
        "info": [info.InfoCfg],
        "doctor": [doctor.DoctorCfg],
    }.get(command, [])


def cases(words: Mapping[str, Iterable[str]]) -> str:
    """Return the branches of the shell script's `case` statement: for each name, the words that may follow it."""
    return "\n".join(f'            {name}) words="{" ".join(each)}" ;;' for name, each in words.items())

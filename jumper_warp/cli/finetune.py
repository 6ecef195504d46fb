"""`jumper finetune POLICY`: reduce a jumping policy's errors by gradients through physics and network."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from types import ModuleType

from jumper_warp.cli.evaluate import policy_of
from jumper_warp.cli.flags import parse

ABOUT = """\
Reduce the errors of a jumping policy by gradients through physics, motors and
network, and save the result as a new policy."""


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper finetune` with the given arguments.

    modules: loaded by --task-module, for tasks outside the project.
    Raises UsageError, InputError or OSError: the policy or a flag is invalid.
    """
    policy = policy_of("finetune", ABOUT, args)
    from jumper_warp.evaluation.finetuning_cfg import FinetuneArgs
    from jumper_warp.policies.catalog import find_policy, newest_run

    name = str(newest_run(policy))
    if Path(name).suffix != ".pt":
        find_policy(name)  # a misspelt name is reported before PyTorch is imported
    parsed: FinetuneArgs = parse(FinetuneArgs, f"finetune {name}", args[1:])
    from jumper_warp.utils.progress import phase

    with phase(f"opening {name}"):
        from jumper_warp.evaluation.finetuning import finetune
        from jumper_warp.policies.policy import Policy, checked_folder, save_policy
        from jumper_warp.utils.locks import write_lock
        from jumper_warp.utils.runtime import configure_device

        policy = Policy.load(name)
    out = checked_folder(parsed.out or Path(f"{Path(name).name}_finetuned"), parsed.overwrite)
    out.parent.mkdir(parents=True, exist_ok=True)
    with write_lock(out, out.with_name(f".{out.name}.lock")):  # beside the folder, which is replaced as a whole
        configure_device(parsed.device, parsed.threads)
        log = partial(print, file=sys.stderr if parsed.json else sys.stdout)
        policy, record = finetune(policy, parsed, modules, log)
        content = json.dumps(record, indent=1) + "\n"
        folder = save_policy(out, policy, files={"finetuning.json": content.encode()}, overwrite=parsed.overwrite)
        print(content if parsed.json else f"{folder}\n", end="")

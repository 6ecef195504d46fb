"""Check that no world becomes non-finite under random actions for a long time, and write metrics.

    python experiments/soak_test.py --num-envs 4096 --steps 2500 --out outputs/soak
    python experiments/soak_test.py --num-envs 16384 --steps 61036 --task velocity-rough   # a billion steps
    python experiments/soak_test.py --num-envs 16384 --steps 12208 --task all --max-seconds 80 --out outputs/soak
    python experiments/soak_test.py --num-envs 2 --steps 1000000 --task vertical-jump --rebuilds 200 --resets 1000

Actions are random target angles of all motors within the limits of the jump. Worlds are reset every `--episode-steps`.
Masses and paw friction differ between worlds. With `--task` a whole randomised environment of any task takes random
actions, and its episodes end and begin as in training; a terrain map has only its hardest row. On a GPU the steps for
which an action is held are one graph. With `--max-seconds` and `--out` a long test can be split into several starts. On
Linux the growth of resident memory is measured too; on a CPU it shows leaks of steps, environments and resets.
"""

from __future__ import annotations

import torch

from jumper_warp.robot.motors import vertical_jump_filter
from jumper_warp.sim.simulation import Simulation
from support.scripts import prepare, report, run_script
from support.soak import SoakArgs, soak_simulation, soak_tasks


def main(args: SoakArgs) -> dict:
    """Run a simulation or an environment under random actions for a long time, and return the metrics."""
    folder = prepare("soak_test", args, args.threads)
    torch.manual_seed(args.seed)
    if args.task is None:
        command_filter = vertical_jump_filter() if args.command_filter else None
        sim = Simulation(args.num_envs, command_filter=command_filter, visuals=False, device=args.device)
        metrics = soak_simulation(sim, args)
    else:
        metrics = soak_tasks(args, folder)
    saved = metrics | {"envs": args.num_envs, "filter": args.command_filter, "seed": args.seed}
    keys = (
        "steps",
        "non_finite_worlds",
        "share_of_steps_contact_unsolved",
        "largest_speed_m_s",
        "steps_per_s",
        "resident_growth_kib_per_1000_steps",
    )
    report(args, folder, saved, f"{metrics['steps']:,} policy steps with random actions", keys)
    return metrics


if __name__ == "__main__":
    run_script(main, SoakArgs)

"""Random actions for a long time: does any world ever become non-finite?

    python experiments/soak_test.py --num-envs 4096 --steps 2500 --out outputs/soak
    python experiments/soak_test.py --num-envs 16384 --steps 61036 --task velocity-rough   # a billion steps

An action is a target angle for every motor, drawn anew at random within the limits of the jump. Worlds start again
after `--episode-steps`, the legs' masses and the paws' friction differ from world to world. With `--task` it is a whole
environment of any task, randomised, that takes random actions: its episodes end and begin on their own. A map of
grounds has its hardest row alone. On a GPU the steps for which an action is held are one graph.
"""

from __future__ import annotations

import torch

from jumper_warp.cli.main import run_command
from jumper_warp.envs.env import Env
from jumper_warp.registry import make_task
from jumper_warp.robot.motors import vertical_jump_filter
from jumper_warp.sim.simulation import Simulation
from support.scripts import parse_flags, prepare, report
from support.soak import SoakArgs, hardest, soak_env, soak_simulation


def main(args: SoakArgs) -> dict:
    """Run the soak test and return its figures."""
    folder = prepare("soak_test", args, args.threads)
    torch.manual_seed(args.seed)
    if args.task is None:
        command_filter = vertical_jump_filter() if args.command_filter else None
        sim = Simulation(args.num_envs, command_filter=command_filter, visuals=False, device=args.device)
        figures = soak_simulation(sim, args)
    else:
        task = hardest(make_task(args.task))
        env = Env(task, args.num_envs, seed=args.seed, device=args.device, threads=args.threads)
        figures = soak_env(env, args) | {"task": args.task}
    report(folder, figures | {"envs": args.num_envs, "filter": args.command_filter, "seed": args.seed})
    return figures


if __name__ == "__main__":
    run_command(lambda: main(parse_flags(SoakArgs)))

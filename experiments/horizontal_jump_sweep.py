"""The paper's test of the horizontal jump: a policy jumps 0.3 to 1.5 m straight ahead, spread evenly, each once.

    python experiments/horizontal_jump_sweep.py --policy horizontal_jump --num-jumps 200 --out outputs/sweep

Runs the suite `sweep` of policies that jump to landing positions, as `jumper evaluate horizontal_jump --suite sweep`.
"""

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.sweeps import DistanceSweep
from support.scripts import parse_flags

if __name__ == "__main__":
    run_command(lambda: parse_flags(DistanceSweep).run())

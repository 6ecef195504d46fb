"""The paper's test of the horizontal jump: a policy jumps 0.3 to 1.5 m straight ahead, spread evenly, each once.

    python experiments/horizontal_jump_sweep.py --policy horizontal_jump --num-jumps 200 --out outputs/sweep

Runs the suite `sweep` of policies that jump to landing positions, as `jumper evaluate horizontal_jump --suite sweep`.
"""

from jumper_warp.evaluation.sweeps import DistanceSweep
from support.scripts import run_script

if __name__ == "__main__":
    run_script(DistanceSweep.run, DistanceSweep)

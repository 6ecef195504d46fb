"""The paper's test of the vertical jump: a policy jumps to heights spread evenly over 0.5 to 1.2 m, each once.

    python experiments/vertical_jump_sweep.py --policy vertical_jump --num-jumps 200 --out outputs/sweep
    python experiments/vertical_jump_sweep.py --gain-scale 0.6 1 --height-range 0.55 1.05   # weak motors

Runs the suite `sweep` of policies that jump to heights, as `jumper evaluate vertical_jump --suite sweep` does.
"""

from jumper_warp.evaluation.sweeps import HeightSweep
from support.scripts import run_script

if __name__ == "__main__":
    run_script(HeightSweep.run, HeightSweep)

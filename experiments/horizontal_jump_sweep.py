"""Measure how exactly a policy jumps straight ahead, and write metrics, a plot, a picture and a recording.

    python experiments/horizontal_jump_sweep.py --policy horizontal_jump --num-jumps 200 --out outputs/sweep

This is the paper's test of the horizontal jump: goals spread evenly over 0.3 to 1.5 m ahead, one jump each. A jump
succeeds if it starts on command, only paws touch anything, and a second after touchdown the base is at rest within 0.1
m of the goal. `jumper evaluate horizontal_jump --suite range` runs the same test.
"""

from jumper_warp.evaluation.sweeps import DistanceSweep
from support.scripts import run_script

if __name__ == "__main__":
    run_script(DistanceSweep.run, DistanceSweep)

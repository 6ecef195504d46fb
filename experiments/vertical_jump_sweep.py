"""Measure how exactly a policy jumps to heights, and write metrics, a plot, a picture and a recording.

    python experiments/vertical_jump_sweep.py --policy vertical_jump --num-jumps 200 --out outputs/sweep
    python experiments/vertical_jump_sweep.py --gain-scale 0.6 1 --height-range 0.55 1.05   # weak motors

This is the paper's test of the vertical jump: heights spread evenly over 0.5 to 1.2 m, one jump each. A height is
reached if the highest base height is within 0.1 m of it. A jump succeeds if it also starts on command, only paws touch
anything, and the base is at rest a second after touchdown. The open-loop jump of the same robots shows the height that
each can reach. `jumper evaluate vertical_jump --suite range` runs the same test.
"""

from jumper_warp.evaluation.sweeps import HeightSweep
from support.scripts import run_script

if __name__ == "__main__":
    run_script(HeightSweep.run, HeightSweep)

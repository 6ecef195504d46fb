"""Measure how exactly a policy jumps diagonally forward, and write metrics, a plot, a picture and a recording.

    python experiments/diagonal_jump_grid.py --policy horizontal_jump --out outputs/grid

This is the paper's test of diagonal jumps: goals on a grid 0.35 to 1.4 m ahead and up to 0.35 m to either side, two
jumps each. `jumper evaluate horizontal_jump --suite grid` runs the same test.
"""

from jumper_warp.evaluation.suites import Grid
from support.scripts import run_script

if __name__ == "__main__":
    run_script(Grid.run, Grid)

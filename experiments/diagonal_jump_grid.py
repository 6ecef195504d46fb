"""The paper's test of diagonal jumps: goals on a grid 0.35 to 1.4 m ahead and 0.35 m to either side, two jumps each.

    python experiments/diagonal_jump_grid.py --policy horizontal_jump --out outputs/grid

Runs the suite `grid`, as `jumper evaluate horizontal_jump --suite grid` does.
"""

from jumper_warp.evaluation.suites import Grid
from support.scripts import run_script

if __name__ == "__main__":
    run_script(Grid.run, Grid)

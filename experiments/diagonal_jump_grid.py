"""The paper's test of diagonal jumps: goals on a grid 0.35 to 1.4 m ahead and 0.35 m to either side, two jumps each.

    python experiments/diagonal_jump_grid.py --policy horizontal_jump --out outputs/grid

Runs the suite `grid`, as `jumper evaluate horizontal_jump --suite grid` does.
"""

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.suites import Grid
from support.scripts import parse_flags

if __name__ == "__main__":
    run_command(lambda: parse_flags(Grid).run())

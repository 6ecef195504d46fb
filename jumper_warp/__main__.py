"""`python -m jumper_warp` runs the command `jumper`."""

from jumper_warp.cli.main import main

main()

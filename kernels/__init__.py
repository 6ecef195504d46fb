"""Warp kernels of the robot's physics, tasks and rewards. Import them as `jumper_warp.kernels`."""

if __name__ == "kernels":  # found from the repository's root; loading the files twice would make every struct twice
    raise ImportError("import jumper_warp.kernels: the folder kernels/ is not a package of its own")

"""Set-up of all tests: one OpenMP thread, Hypothesis without deadlines, kernels compiled once, a shared fixture."""

import os
import subprocess
import sys

os.environ.setdefault("OMP_NUM_THREADS", "1")  # workers share the cores; before torch reads it

import pytest
import torch
import warp as wp
from hypothesis import HealthCheck, settings

from ground_helpers import hardest
from hold_height import hold_height
from jumper_warp.envs.env import Env
from jumper_warp.registry import make_task

wp.config.log_level = wp.LOG_WARNING
settings.register_profile("tests", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("tests")  # a loaded machine is no failure
SHARED = ("vertical-jump", "horizontal-jump", "velocity-flat", "velocity-rough", "attitude")
"""Tasks whose kernels many files use, in addition to `hold_height`."""
LONGEST = (
    "test_pages_howto.py", "test_pages_tutorials.py", "test_sysid.py", "test_drive_in_browser.py", "test_sweep.py",
    "test_finetuning.py", "test_identification.py", "test_extras.py", "test_torchrun.py", "test_exported_robot.py",
)  # fmt: skip
"""Files that begin first, so that at the end no worker waits for a long one; with --no-loadscope-reorder."""
MUJOCO_STEP = """
import warp as wp
from jumper_warp.sim.simulation import Simulation
wp.config.log_level = wp.LOG_WARNING
Simulation(2, solver="mujoco", visuals=False, device="cpu").step()
"""


def pytest_sessionstart(session):
    """Compile the kernels of most files before pytest's workers start, if several workers run the whole suite."""
    options = session.config.option
    if (getattr(options, "numprocesses", None) or 0) > 1 and not options.file_or_dir:
        with subprocess.Popen([sys.executable, "-c", MUJOCO_STEP]):  # at the same time
            for name in SHARED:
                Env(hardest(make_task(name)), 2, device="cpu").compile()  # with a small map
            Env(hold_height(), 2, device="cpu").compile()


def pytest_collection_modifyitems(items):
    """Begin with the files that take longest."""
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))


@pytest.fixture(scope="module", autouse=True)
def registered_tasks():
    """Remove the tasks that a module's tests register, which other modules do not expect."""
    from jumper_warp.registry import TASKS

    before = dict(TASKS)
    yield
    TASKS.clear()
    TASKS.update(before)


@pytest.fixture(scope="module")
def one_thread():
    """Limit torch to one thread during a module's tests, which is faster for small networks."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)

import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("variables", "spin_count"),
    [({}, "20000"), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "passive"}, "None")],
)
def test_import_sets_openmp_spin_count_unless_the_user_did_and_does_not_import_torch(variables, spin_count):
    inherited = {name: value for name, value in os.environ.items() if name not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    code = "import os, sys, jumper_warp; print(os.environ.get('GOMP_SPINCOUNT'), 'torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], env=inherited | variables, capture_output=True, text=True)
    assert done.stdout.split() == [spin_count, "False"], done.stderr


@pytest.mark.parametrize(("level", "loud"), [("", False), ("wp.config.log_level = wp.LOG_DEBUG", True)])
def test_a_script_is_quiet_about_loaded_kernels_and_a_missing_driver_unless_the_user_sets_the_level(level, loud):
    code = f"import warp as wp; from jumper_warp import build_model; {level or 'pass'}; build_model(1)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ("Module " in done.stdout + done.stderr) == loud and "NVIDIA CUDA driver" not in done.stderr

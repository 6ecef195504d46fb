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


@pytest.mark.parametrize(
    ("first", "variables", "worlds", "threads"),
    [
        ("torch", {}, 64, 1), ("torch", {}, 2, 2), ("jumper_warp", {}, 64, 2),
        ("torch", {"OMP_NUM_THREADS": "2"}, 64, 2), ("torch", {"GOMP_SPINCOUNT": "7"}, 64, 2),
    ],
)  # fmt: skip
def test_torch_gets_one_thread_if_its_idle_threads_would_spin_beside_a_simulation(first, variables, worlds, threads):
    names = ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY", "OMP_NUM_THREADS")
    inherited = {name: value for name, value in os.environ.items() if name not in names}
    code = f"""if True:
        import {first}, torch
        if "OMP_NUM_THREADS" not in {variables}:
            torch.set_num_threads(2)
        from jumper_warp import Simulation
        Simulation({worlds}, threads=2, device="cpu", visuals=False)
        print(torch.get_num_threads())
    """
    done = subprocess.run([sys.executable, "-c", code], env=inherited | variables, capture_output=True, text=True)
    assert done.stdout.split()[-1:] == [str(threads)], done.stderr


@pytest.mark.parametrize(
    ("level", "first", "loud"),
    [("pass", "build_model(1)", False), ("wp.config.log_level = wp.LOG_DEBUG", "build_model(1)", True),
     ("pass", "Env(make_task('attitude'), 1)", False)],
)  # fmt: skip
def test_a_script_is_quiet_about_loaded_kernels_and_a_missing_driver_unless_the_user_sets_the_level(level, first, loud):
    code = f"import warp as wp; from jumper_warp import Env, build_model, make_task; {level}; {first}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ("Module " in done.stdout + done.stderr) == loud and "NVIDIA CUDA driver" not in done.stderr

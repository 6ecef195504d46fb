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

import subprocess
import sys

import pytest

CODE = """
import ctypes, resource
import torch
from jumper_warp.utils.allocator import MMAP_THRESHOLD, keep_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(3):
        arrays = [torch.ones(200_000) for _ in range(100)]  # 0.8 MB each
        del arrays
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

assert ctypes.CDLL(None).mallopt(MMAP_THRESHOLD, 128 << 10) == 1  # as it is at first: larger blocks are given back
given_back = faults()
told = keep_freed_memory()
faults()
print(told, given_back, faults())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc")
def test_freed_memory_is_kept():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    told, given_back, kept = done.stdout.split()
    assert told == "True"
    assert int(given_back) > 50_000  # 3 x 80 MB are 58,594 pages
    assert int(kept) < 1000

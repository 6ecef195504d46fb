import subprocess
import sys

import pytest

PROGRAM = """
import ctypes, resource
import torch
from jumper_warp.utils.allocator import MMAP_THRESHOLD, keep_freed_memory

def page_faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(3):
        arrays = [torch.ones(200_000) for _ in range(100)]  # 0.8 MB each
        del arrays
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

assert ctypes.CDLL(None).mallopt(MMAP_THRESHOLD, 128 << 10) == 1  # the default: larger blocks are freed
faults_before = page_faults()
accepted = keep_freed_memory()
page_faults()  # the heap grows once
print(accepted, faults_before, page_faults())
"""
"""Prints the result of keep_freed_memory, and page faults of 3 x 100 allocations before and after it."""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc")
def test_freed_memory_causes_no_page_faults_on_reuse():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    accepted, faults_before, faults_after = done.stdout.split()
    assert accepted == "True"
    assert int(faults_before) > 50_000  # 3 x 80 MB are 58,594 pages of 4 KiB
    assert int(faults_after) < 1000

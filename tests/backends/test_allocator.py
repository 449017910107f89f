import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys, torch
from torchmeso.backends.allocator import give_back_freed_memory, keep_freed_memory
kept = keep_freed_memory() if sys.argv[1] != "leave" else False
kept = give_back_freed_memory() if sys.argv[1] == "give back" else kept
for _ in range(3): torch.empty(1 << 24).fill_(1)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20): torch.empty(1 << 24).fill_(1)
print(kept, resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc only")
def test_blocks_that_come_again_do_not_fault_again():
    """64 MiB at a time: above what glibc keeps on its own accord."""

    def faults(mode):
        said = subprocess.run([sys.executable, "-c", PROGRAM, mode], capture_output=True, text=True, check=True).stdout
        kept, count = said.split()
        return kept, int(count)

    kept, few = faults("keep")
    if kept != "True":
        pytest.skip("another C library")
    assert few < 0.6 * faults("leave")[1]
    assert faults("give back")[1] > 2 * few


FITTING = """
import re, sys, torch
from torchmeso.backends.allocator import give_back_freed_memory, keep_freed_memory
kept = keep_freed_memory() and (sys.argv[1] == "keep" or give_back_freed_memory())
blocks = [(torch.empty(5 << 20).fill_(1), torch.empty(50000).fill_(1)) for _ in range(12)]  # 20 MiB, 200 kB
small = [x for _, x in blocks]
del blocks
print(kept, re.search(r"VmRSS:\\s*(\\d+)", open("/proc/self/status").read())[1])
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc only")
def test_a_fit_that_keeps_little_of_much_stays_small():
    def resident(mode):
        said = subprocess.run([sys.executable, "-c", FITTING, mode], capture_output=True, text=True, check=True).stdout
        kept, size = said.split()
        return kept, int(size)

    kept, small = resident("give back")
    if kept != "True":
        pytest.skip("another C library")
    assert small + 150_000 < resident("keep")[1]


def test_other_systems_are_left_alone(monkeypatch):
    from torchmeso.backends import allocator

    monkeypatch.setattr(sys, "platform", "darwin")
    assert not allocator.keep_freed_memory()
    assert not allocator.give_back_freed_memory()

import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys, torch
from torchmeso.backends.allocator import keep_freed_memory
kept = keep_freed_memory() if sys.argv[1] == "keep" else False
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


def test_other_systems_are_left_alone(monkeypatch):
    from torchmeso.backends import allocator

    monkeypatch.setattr(sys, "platform", "darwin")
    assert not allocator.keep_freed_memory()

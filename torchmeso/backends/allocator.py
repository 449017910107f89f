"""Keep freed memory: large tensors come and go every frame, and their pages would be faulted in every time.

glibc gives blocks above 128 KiB back to the system as soon as they are freed, and the next tensor of that size
faults its pages in again, one by one. A program that renders keeps them instead.

Test: tests/backends/test_allocator.py
"""

import ctypes
import sys

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Options of mallopt(3)."""

KEEP = 1 << 30
"""Bytes of a block up to which it comes from, and free memory up to which it stays in, the program's own heap."""


def keep_freed_memory() -> bool:
    """Tell the C library to keep freed memory for the next tensor; return whether it understood.

    A choice for a whole program (the command line, a viewer), never made by importing the library.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        libc = ctypes.CDLL("libc.so.6")
        # The dynamic threshold of mmap is off as soon as one is set; both must be.
        return bool(libc.mallopt(M_MMAP_THRESHOLD, KEEP)) and bool(libc.mallopt(M_TRIM_THRESHOLD, KEEP))
    except (OSError, AttributeError):
        return False

"""What the C library does with freed memory: kept for the frames of a renderer, given back by fits.

glibc gives blocks above 128 KiB back to the system as soon as they are freed, and the next tensor of that size
faults its pages in again, one by one. A program that renders keeps them instead: its tensors come and go every frame.
A fit must not: small results that stay lie between the blocks it frees, and 1.2 GB became 2 to 6 GB.

Test: tests/backends/test_allocator.py
"""

import ctypes
import sys

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Options of mallopt(3)."""

KEEP = 1 << 30
"""Bytes of a block up to which it comes from, and free memory up to which it stays in, the heap of a renderer."""

GIVE_BACK = 16 << 20
"""The same of a fit."""


def keep_freed_memory() -> bool:
    """Tell the C library to keep freed memory for the next tensor; return whether it understood.

    A choice for a whole program (the command line, a viewer), never made by importing the library.
    """
    return _set(KEEP)


def give_back_freed_memory() -> bool:
    """Tell the C library to give freed memory back to the system; return whether it understood.

    As `keep_freed_memory`, for programs whose peak of memory counts.
    """
    return _set(GIVE_BACK)


def _set(size: int) -> bool:
    if not sys.platform.startswith("linux"):
        return False
    try:
        libc = ctypes.CDLL("libc.so.6")
        # The dynamic threshold of mmap is off as soon as one is set; both must be.
        return bool(libc.mallopt(M_MMAP_THRESHOLD, size)) and bool(libc.mallopt(M_TRIM_THRESHOLD, size))
    except (OSError, AttributeError):
        return False

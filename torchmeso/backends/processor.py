"""What this processor can do, and a name for it that PoCL's compiler knows.

PoCL asks LLVM for the processor's name. LLVM calls an AMD processor younger than itself (Zen 5 for the LLVM 14 in
PyPI's wheel) "generic", and then refuses that very word: no kernel builds (pocl/pocl issue 1049, open; no option or
variable of PoCL 3 overrides the name). The name is a string that the device's record points at, so it is replaced
there, in place, by that of an older processor whose instructions this one has.

Test: tests/backends/test_processor.py
"""

import ctypes
import re
from functools import cache
from pathlib import Path

KNOWN = (
    ("znver3", "avx2 bmi2 fma sse4a sha_ni clzero clwb vaes vpclmulqdq rdpid fsrm"),
    ("znver1", "avx2 bmi2 fma sse4a sha_ni clzero"),
    ("haswell", "avx2 bmi1 bmi2 fma f16c abm movbe"),
    ("x86-64", "sse2"),
)
"""Names of at most seven letters that LLVM knows, and the instructions each takes for granted; the best comes first."""

UNKNOWN = b"generic\0"
RECORD = 2048
"""Bytes of a device's record that are searched; the pointer stands at 640 in PoCL 3.0."""


@cache
def flags() -> frozenset[str]:
    """Return the instructions of this processor as Linux names them; none where that cannot be told."""
    try:
        found = re.search(r"^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        return frozenset()
    return frozenset(found[1].split()) if found else frozenset()


def name_known(has: frozenset[str]) -> str | None:
    """Return the best of `KNOWN` whose instructions are all in `has`; None where not even the last fits."""
    return next((name for name, needs in KNOWN if has.issuperset(needs.split())), None)


def rename(record: int, name: str) -> bool:
    """Replace the name "generic" that a device's record points at.

    Args:
        record: address of PoCL's record of the device (`cl_device_id`).
        name: of at most seven letters.

    Returns:
        Whether there was such a name, just one: else nothing was changed.
    """
    spans = _writable()
    words = range(record, record + RECORD, 8)
    pointers = {ctypes.c_uint64.from_address(at).value for at in words if _inside(spans, at, 8)}
    found = [p for p in pointers if _inside(spans, p, 8) and ctypes.string_at(p, 8) == UNKNOWN]
    if len(found) != 1 or len(name) >= len(UNKNOWN):
        return False
    ctypes.memmove(found[0], name.encode().ljust(len(UNKNOWN), b"\0"), len(UNKNOWN))
    return True


def _writable() -> list[tuple[int, int]]:
    """Return the spans of this process's memory that may be read and written."""
    try:
        lines = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return []
    spans = (line.split()[:2] for line in lines)
    edges = (span.split("-") for span, rights in spans if rights.startswith("rw"))
    return [(int(first, 16), int(last, 16)) for first, last in edges]


def _inside(spans: list[tuple[int, int]], at: int, size: int) -> bool:
    return any(first <= at and at + size <= last for first, last in spans)

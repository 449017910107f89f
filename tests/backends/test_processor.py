"""torchmeso.backends.processor: names that an older compiler knows."""

import ctypes

import pytest

from torchmeso.backends import processor


def record_of(*texts: bytes) -> tuple[int, list[ctypes.Array], ctypes.Array]:
    """Return the address of a record that points at `texts`, and what must be kept alive for it."""
    strings = [ctypes.create_string_buffer(text, 16) for text in texts]
    words = (ctypes.c_uint64 * (processor.RECORD // 8))()
    for i, string in enumerate(strings):
        words[3 * i + 1] = ctypes.addressof(string)
    words[50], words[51] = 1, 2**63  # no addresses
    return ctypes.addressof(words), strings, words


@pytest.mark.parametrize("name", [name for name, _ in processor.KNOWN])
def test_the_name_is_replaced_in_place(name):
    record, strings, _words = record_of(b"pthread", b"generic", b"AuthenticAMD")
    assert processor.rename(record, name)
    assert [s.value.decode() for s in strings] == ["pthread", name, "AuthenticAMD"]


@pytest.mark.parametrize("texts", [(b"znver3",), (b"generic", b"generic"), (b"generics",)])
def test_nothing_changes_unless_just_one_name_is_found(texts):
    record, strings, _words = record_of(*texts)
    assert not processor.rename(record, "haswell")
    assert [s.value for s in strings] == list(texts)


def test_a_long_name_has_no_room():
    record, strings, _words = record_of(b"generic")
    assert not processor.rename(record, "skylake-avx512")
    assert strings[0].value == b"generic"


def test_the_best_name_whose_instructions_are_there():
    assert processor.name_known(frozenset(["sse2", "avx2", "bmi1", "bmi2", "fma", "f16c", "abm", "movbe"])) == "haswell"
    assert processor.name_known(frozenset(["sse2"])) == "x86-64"
    assert processor.name_known(frozenset()) is None
    zen = frozenset(" ".join(needs for _, needs in processor.KNOWN).split())
    assert processor.name_known(zen) == "znver3"
    assert processor.name_known(zen - {"clwb"}) == "znver1"

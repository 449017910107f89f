import pytest

from torchmeso.bench import fuzz, fuzz_readers
from torchmeso.bench.suite import Context


@pytest.mark.parametrize("name", fuzz_readers.FAMILIES)
def test_whole_files_are_read(name, tmp_path):
    for place, (whole, read) in fuzz_readers.FAMILIES[name](tmp_path).items():
        (tmp_path / place).write_bytes(whole)
        read(tmp_path / place)


@pytest.mark.parametrize("name", fuzz_readers.FAMILIES)
def test_only_our_errors_leave_the_readers(name):
    assert fuzz.strangers(fuzz_readers.kind(name), 250) == []


@pytest.mark.parametrize("name", fuzz_readers.FAMILIES)
def test_files_cut_off(name):
    assert fuzz_readers.cut(name, 97) == []


@pytest.mark.slow
def test_a_hundred_thousand_of_each():
    assert [row.to_json() for row in fuzz_readers.families(Context()) if not row.met] == []

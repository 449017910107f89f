import pytest
import torch

from torchmeso.data import journal
from torchmeso.errors import FormatError, StorageError


def test_parts_outlive_a_job_that_failed_and_not_one_that_ended(tmp_path, rng):
    values = torch.rand(4, 3, 2, generator=rng)
    with pytest.raises(KeyboardInterrupt), journal.beside(tmp_path / "a.meso", "job") as kept:
        kept.write("x", values)
        raise KeyboardInterrupt
    with journal.beside(tmp_path / "a.meso", "job") as kept:
        assert kept.has("x", (4, 3, 2), torch.float32)
        assert not kept.has("x", (5, 3, 2), torch.float32)
        assert not kept.has("y", (4, 3, 2), torch.float32)
        assert torch.equal(kept.read("x", (4, 3, 2), torch.float32), values)
        assert torch.equal(kept.read("x", (4, 3, 2), torch.float32, first=1, count=2), values[1:3])
    assert list(tmp_path.iterdir()) == []


def test_another_job_begins_anew(tmp_path):
    with pytest.raises(RuntimeError), journal.beside(tmp_path / "a.meso", "one") as kept:
        kept.write("x", torch.zeros(3))
        raise RuntimeError
    with journal.beside(tmp_path / "a.meso", "two") as kept:
        assert not kept.has("x", (3,), torch.float32)


@pytest.mark.errors
def test_what_cannot_be_read_or_written_is_told(tmp_path):
    with journal.beside(tmp_path / "a.meso", "one") as kept:
        kept.write("x", torch.zeros(2))
        with pytest.raises(FormatError, match="expected 3 numbers, got 2; remove it"):
            kept.read("x", (3,), torch.float32)
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="could not be written"), journal.beside(tmp_path / "file" / "b.meso", "one"):
        pass


def test_a_state_changes_with_a_file(tmp_path):
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "a").write_text("1")
    before = journal.state_of(tmp_path / "set"), journal.state_of(tmp_path / "set" / "a")
    assert (journal.state_of(tmp_path / "set"), journal.state_of(tmp_path / "set" / "a")) == before
    (tmp_path / "set" / "a").write_text("12")
    assert journal.state_of(tmp_path / "set") != before[0]
    assert journal.state_of(tmp_path / "set" / "a") != before[1]
    assert journal.state_of(tmp_path / "missing") != journal.state_of(tmp_path / "absent")

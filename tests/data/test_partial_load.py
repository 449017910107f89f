"""What loading a part of a model reads, counted by the system: pages of the file that are mapped, and bytes read."""

from pathlib import Path

import pytest
import torch

from torchmeso.data import eigen_btf, sh_btf, sh_pca_btf, store
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.data.sh_btf import ShBtf
from torchmeso.data.sh_pca_btf import ShPcaBtf
from torchmeso.geometry import hemisphere

SET = hemisphere.grid(4, 2, 80)
AROUND = 64 << 10
"""Bytes that one page fault may bring along, at either end of a tensor."""


@pytest.fixture
def count(monkeypatch):
    """Return a function that tells how many bytes of a file a call reads or maps."""
    if not Path("/proc/self/smaps").exists() or not Path("/proc/self/io").exists():
        pytest.skip("the system does not tell what a process reads")
    open_models = []
    init = store.Model.__init__

    def kept(self, path):
        init(self, path)
        open_models.append(self)

    monkeypatch.setattr(store.Model, "__init__", kept)

    def counted(path, load):
        before = bytes_read()
        load()
        read = bytes_read() - before
        found = resident(path) + read
        open_models.clear()
        return found

    return counted


def bytes_read():
    said = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return int(said["rchar"])


def resident(path):
    """Return the bytes of a file that lie in this process's memory."""
    total, here = 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        first = line.split()[0]
        if not first.endswith(":"):
            here = line.endswith(str(path))
        elif here and first == "Rss:":
            total += 1024 * int(line.split()[1])
    return total


def codes(*shape, rng):
    return torch.randint(0, 256, shape, generator=rng, dtype=torch.uint8)


@pytest.mark.parametrize("coded", [False, True], ids=["maps", "streams"])
def test_eight_of_32_components(coded, count, tmp_path, rng):
    model = EigenBtf(
        maps=codes(8, 96, 96, 32, 3, rng=rng), weights=torch.rand(8, 32), scale=torch.rand(32, 3),
        offset=torch.rand(32, 3), lights=SET, views=SET,
    )  # fmt: skip
    eigen_btf.save(model, tmp_path / "a.meso", coded=coded)
    size, each = (tmp_path / "a.meso").stat().st_size, 8 * 96 * 96 * 3
    assert 32 * each < size
    few = count(tmp_path / "a.meso", lambda: eigen_btf.load(tmp_path / "a.meso", rank=8))
    assert 8 * each <= few < 8 * each + 18 * AROUND
    assert few < 0.4 * size
    whole = count(tmp_path / "a.meso", lambda: eigen_btf.load(tmp_path / "a.meso"))
    assert whole > 0.95 * size  # or the count would not mean anything


@pytest.mark.parametrize("coded", [False, True], ids=["maps", "streams"])
def test_bands_up_to_two_of_five(coded, count, tmp_path, rng):
    model = ShBtf(
        maps=codes(25, 25, 64, 64, 3, rng=rng), scale=torch.rand(25, 25, 3), offset=torch.rand(25, 25, 3),
        lights=hemisphere.ubo81(), views=hemisphere.ubo81(),
    )  # fmt: skip
    sh_btf.save(model, tmp_path / "a.meso", coded=coded)
    needed = 81 * 64 * 64 * 3
    few = count(tmp_path / "a.meso", lambda: sh_btf.load(tmp_path / "a.meso", degree=2))
    assert needed <= few < needed + 2 * (27 if coded else 9) * AROUND
    assert few < 0.5 * (tmp_path / "a.meso").stat().st_size


def test_three_of_24_weights_of_sh_pca(count, tmp_path, rng):
    model = ShPcaBtf(
        maps=codes(8, 128, 128, 24, rng=rng), scale=torch.rand(24), offset=torch.rand(24), basis=torch.rand(24, 9, 3),
        lights=SET, views=SET,
    )  # fmt: skip
    sh_pca_btf.save(model, tmp_path / "a.meso")
    needed = 3 * 8 * 128 * 128
    few = count(tmp_path / "a.meso", lambda: sh_pca_btf.load(tmp_path / "a.meso", rank=3))
    assert needed <= few < needed + 8 * AROUND

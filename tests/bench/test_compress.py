from dataclasses import replace

import torch

from torchmeso.bench import compress
from torchmeso.bench.suite import Context
from torchmeso.compress import double_sh
from torchmeso.compress.double_sh import DoubleShOptions


def test_the_table_is_like_a_btf():
    raw = compress.like_a_btf(4)
    assert raw.shape == (81, 81, 48)
    assert raw.dtype == torch.uint8
    assert raw.float().std() > 10
    assert (raw == 255).float().mean() < 0.2


def test_the_peers_solve_the_same_problem(device):
    raw = compress.like_a_btf(2)
    sides = compress._sides(DoubleShOptions(light_terms=16, view_terms=9))
    ours = double_sh.project(raw, *sides, unit=compress.UNIT, backend="opencl")
    torch.testing.assert_close(compress._bisected(raw, *sides), ours, rtol=0, atol=1e-3)
    free = compress._sides(DoubleShOptions(light_terms=9, view_terms=9, energy=None))
    ours = double_sh.project(raw, *free, unit=compress.UNIT, backend="opencl")
    torch.testing.assert_close(compress._products(raw, *free), ours, rtol=0, atol=1e-4)


def test_a_sound_solver_meets_its_rows(device):
    rows = list(compress._sound(compress.like_a_btf(4)[:, :, :48].contiguous(), 25))
    assert [row.id for row in rows] == ["compress.cls.bound.25", "compress.cls.float32.25"]
    assert all(row.met for row in rows)


def test_eight_bits(device, monkeypatch):
    small = compress.like_a_btf(4)
    monkeypatch.setattr(compress, "like_a_btf", lambda size: small)
    rows = list(compress.quantised(Context(quick=True)))
    assert rows[-1].id == "compress.quantised.36"
    assert rows[-1].met


def test_error_over_size(monkeypatch):
    options, brick = compress.BtfOptions, compress.generators.brick
    monkeypatch.setattr(compress, "BtfOptions", lambda **k: replace(options(**k), texels=6))
    monkeypatch.setattr(compress.generators, "brick", lambda: brick(rows=6))
    rows = {row.id.removeprefix("compress.rate.brick."): row.value for row in compress.rate(Context(quick=True))}
    assert rows["eigen.16"] > rows["eigen.4"] > rows["eigen.1"]
    assert rows["double-sh.1"] > rows["double-sh.unbounded"]

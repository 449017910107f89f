import numpy as np
import pytest
import torch

from tests.data import btf_bytes
from torchmeso.compress import dfmf
from torchmeso.compress.dfmf import DfmfOptions
from torchmeso.data import btfdbb, btfdbb_write
from torchmeso.data.btf import Btf
from torchmeso.data.btfdbb_colour import Colour
from torchmeso.errors import ConfigError, ShapeError, SizeError
from torchmeso.geometry import hemisphere

LIGHTS, VIEWS = hemisphere.grid(4, 2, 80), hemisphere.ubo81()


@pytest.fixture
def table(rng):
    """Brightness from 0.02 to 50, far beyond white, of colours as materials have them."""
    brightness = torch.exp(8 * torch.rand(8, 81, 5, 3, 1, generator=rng) - 4)
    images = brightness * (0.2 + 0.8 * torch.rand(8, 81, 5, 3, 3, generator=rng))
    return Btf(images=images, lights=LIGHTS, views=VIEWS)


def ulps(got, expected):
    """Error in units in the last place of a half."""
    return ((got - expected).abs() / torch.from_numpy(np.spacing(expected.half().numpy())).float()).max()


@pytest.mark.parametrize("compression", ["full", "bzip", "sparse"])
@pytest.mark.parametrize("chunk_rows", [1, 4, 9])
def test_bdi_keeps_halves(tmp_path, table, compression, chunk_rows):
    shares = []
    btfdbb_write.write_bdi(
        tmp_path / "a.btf", table, compression=compression, chunk_rows=chunk_rows, progress=shares.append
    )
    found = btfdbb.load(tmp_path / "a.btf")
    assert (found.views, found.lights.count) == (VIEWS, LIGHTS.count)
    assert torch.equal(found.rows(0, 5), table.images.half().float())
    assert shares[-1] == 1
    assert [p.name for p in tmp_path.iterdir()] == ["a.btf"]


def test_sparse_files_leave_out_what_was_not_measured(tmp_path, table):
    mask = torch.zeros(5, 3, dtype=torch.bool)
    mask[0, 1] = mask[3, 2] = True
    btfdbb_write.write_bdi(tmp_path / "a.btf", table, compression="sparse", mask=mask)
    btfdbb_write.write_bdi(tmp_path / "b.btf", table, mask=mask)
    assert (tmp_path / "a.btf").stat().st_size < 0.3 * (tmp_path / "b.btf").stat().st_size
    found = btfdbb.load(tmp_path / "a.btf")
    assert found.file.body.facts()["texels measured"] == "13%"
    assert torch.equal(found.rows(0, 5), (table.images * mask[..., None]).half().float())
    assert torch.equal(btfdbb.load(tmp_path / "b.btf").rows(0, 5), table.images.half().float())


@pytest.mark.parametrize("model", [0, 1, 4, 9, 11, 12])
@pytest.mark.parametrize("storage", ["float32", "float64"])
def test_dfmf_of_full_rank_is_within_one_ulp_of_half(tmp_path, table, model, storage):
    options = DfmfOptions(rank=15, colour=Colour(model), accurate=True)
    header = btfdbb_write.header_of(table, "!DFMF08FCR")
    factors = dfmf.fit(table, options)
    btfdbb_write.write_dfmf(tmp_path / "a.btf", header, options.colour, factors, storage=storage)
    found = btfdbb.load(tmp_path / "a.btf")
    assert found.file.body.facts() == {"components": "15, 15, 15", "storage": storage}
    assert found.rows(0, 5).max() > 40
    assert ulps(found.rows(0, 5), table.images) <= 1


def test_factors_come_back_as_they_were_written(tmp_path, table):
    factors = [(u.half(), t.half()) for u, t in dfmf.fit(table, DfmfOptions(rank=4))]
    btfdbb_write.write_dfmf(tmp_path / "a.btf", btfdbb_write.header_of(table, "!DFMF08FCR"), Colour(11), factors)
    body = btfdbb.survey(tmp_path / "a.btf").body
    for c, (by_pair, by_texel) in enumerate(factors):
        np.testing.assert_array_equal(body.by_pair[c], by_pair.numpy())
        np.testing.assert_array_equal(body.by_texel[c], by_texel.numpy())
    rows = btfdbb.load(tmp_path / "a.btf").rows(0, 5)
    log_y = factors[0][0].float() @ factors[0][1].float().mT
    luminance = rows @ torch.tensor([0.299, 0.587, 0.114])  # what the matrix of the format inverts to, nearly
    expected = log_y.exp().reshape(81, 8, 5, 3).flip(2).transpose(0, 1)
    torch.testing.assert_close(luminance, expected, rtol=2e-3, atol=1e-3)


def test_bytes_are_those_of_the_description(tmp_path):
    """The independent writer of the tests and ours, of the same factors, differ in what was measured with only."""
    values = btf_bytes.random_values()
    raw = btf_bytes.dfmf(values, size=4, channels=("R", "G", "B"), signature="!DFMF08FC")
    (tmp_path / "theirs.btf").write_bytes(raw)
    file = btfdbb.survey(tmp_path / "theirs.btf")
    pairs = zip(file.body.by_pair, file.body.by_texel, strict=True)
    factors = [(torch.from_numpy(u.copy()), torch.from_numpy(t.copy())) for u, t in pairs]
    btfdbb_write.write_dfmf(tmp_path / "ours.btf", file.header, file.colour, factors, storage="float32")
    ours = (tmp_path / "ours.btf").read_bytes()
    assert len(ours) == len(raw)
    # The count of components in front is 99 there; norms of S V are the singular values but for rounding.
    differ = [at for at in range(len(raw)) if raw[at] != ours[at]]
    head = len(btf_bytes.header("!DFMF08FC"))
    assert differ[0] == head
    singular = {head + 56 + c * (13 + 60 + 4 * 15 * 39) + 13 + k for c in range(3) for k in range(60)}
    assert set(differ[1:]) <= singular


@pytest.mark.errors
def test_refusals(tmp_path, table):
    path, header = tmp_path / "a.btf", btfdbb_write.header_of(table, "!DFMF08FCR")
    factors = [(torch.ones(648, 2), torch.ones(15, 2))] * 3
    cases = [
        ([*factors[:2]], "expected factors of 3 channels, got 2"),
        ([*factors[:2], (torch.ones(647, 2), torch.ones(15, 2))], r"factors\[2\] by pair: expected shape \(648, 2\)"),
        ([*factors[:2], (torch.ones(648, 2), torch.ones(15, 3))], r"factors\[2\] by texel: expected shape \(15, 2\)"),
        ([(factors[0][0] * 1e5, factors[0][1]), *factors[1:]], r"factors\[0\] as float16: expected finite values"),
    ]
    for wrong, text in cases:
        with pytest.raises(ShapeError, match=text):
            btfdbb_write.write_dfmf(path, header, Colour(0), wrong)
    with pytest.raises(ShapeError, match=r"btfdbb\.mask: expected shape \(5, 3\)"):
        btfdbb_write.write_bdi(path, table, mask=torch.ones(3, 5, dtype=torch.bool))
    with pytest.raises(ConfigError, match="chunk_rows: expected a value from 1"):
        btfdbb_write.write_bdi(path, table, chunk_rows=0)
    bright = Btf(images=table.images * 1e4, lights=LIGHTS, views=VIEWS)
    with pytest.raises(ShapeError, match="values as float16: expected finite values"):
        btfdbb_write.write_bdi(path, bright)
    assert not list(tmp_path.iterdir())


@pytest.mark.errors
def test_chunks_longer_than_the_format_can_tell(tmp_path, table, monkeypatch):
    monkeypatch.setattr(btfdbb_write.btfdbb_bdi, "MEMORY_LIMIT", 10_000)
    with pytest.raises(SizeError, match=r"a chunk: needs .* take fewer rows"):
        btfdbb_write.write_bdi(tmp_path / "a.btf", table)

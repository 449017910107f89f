import struct

import numpy as np
import pytest

from tests.data import btf_bytes
from tests.data.btf_bytes import HEIGHT, PAIRS, TEXELS, WIDTH
from torchmeso.data import btfdbb, btfdbb_body
from torchmeso.errors import FormatError

VALUES = btf_bytes.random_values()


def survey(path, raw, **options):
    (path / "a.btf").write_bytes(raw)
    return btfdbb.survey(path / "a.btf", **options)


FACTORED = {kind: make for kind, make in btf_bytes.KINDS.items() if not kind.startswith("bdi")}


@pytest.mark.parametrize("kind", FACTORED)
def test_parts_are_parts_of_the_whole(tmp_path, kind, monkeypatch):
    body = survey(tmp_path, FACTORED[kind](VALUES)).body
    whole = body.values(slice(0, PAIRS), slice(0, TEXELS))
    monkeypatch.setattr(btfdbb_body, "BLOCK_NUMBERS", 15 * 4)  # four texels at a time
    assert whole.shape == (PAIRS, TEXELS, 3)
    for pairs, texels in (
        (slice(4, 5), slice(0, TEXELS)),
        (slice(0, PAIRS), slice(5, 10)),
        (slice(5, 13), slice(3, 4)),
    ):
        part = body.values(pairs, texels).numpy()
        np.testing.assert_allclose(part, whole[pairs, texels].numpy(), rtol=1e-4, atol=1e-4)


def test_rank_cuts_the_factors(tmp_path):
    exact = np.linalg.svd(VALUES[..., 1])
    best = (exact[0][:, :3] * exact[1][:3]) @ exact[2][:3]
    for raw in (btf_bytes.dfmf(VALUES), btf_bytes.dfmf(VALUES, transposed=True)):
        body = survey(tmp_path, raw, rank=3).body
        assert body.facts()["components"] == "3, 3, 3"
        np.testing.assert_allclose(body.values(slice(0, PAIRS), slice(0, TEXELS))[..., 1], best, rtol=1e-4)
    assert survey(tmp_path, btf_bytes.fmf(VALUES), rank=2).body.facts()["components"] == "2, 2, 2"
    for pictures in (True, False):
        body = survey(tmp_path, btf_bytes.pvf(VALUES, pictures=pictures), rank=2).body
        assert body.facts()["components"] == "2 for each view"
        part = VALUES[:6].reshape(6, -1) if pictures else VALUES[:6].transpose(1, 0, 2).reshape(TEXELS, -1)
        U, S, V = np.linalg.svd(part - part.mean(0), full_matrices=False)
        best = part.mean(0) + (U[:, :2] * S[:2]) @ V[:2]
        best = best.reshape(6, TEXELS, 3) if pictures else best.reshape(TEXELS, 6, 3).transpose(1, 0, 2)
        np.testing.assert_allclose(body.values(slice(0, 6), slice(0, TEXELS)), best, rtol=1e-3)


def test_where_both_orders_fit_rows_are_pairs(tmp_path):
    square = np.concatenate([VALUES, VALUES], 1)[:, :PAIRS]
    body = survey(tmp_path, btf_bytes.dfmf(square, width=6, height=4)).body
    np.testing.assert_allclose(body.values(slice(0, PAIRS), slice(0, 24)), square, rtol=1e-4)


FMF = "!FMF06FCR"
EXTENDED = {"signature": "!FMF12FCE"}


@pytest.mark.errors
@pytest.mark.parametrize(
    ("raw", "text"),
    [
        (btf_bytes.dfmf(VALUES, width=WIDTH + 1), r"channel a: expected factors of 24 and 18, .* got 24 and 15"),
        (btf_bytes.fmf(VALUES, height=HEIGHT + 1), "the factorisation: expected factors of 72 and 20"),
        (btf_bytes.pvf(VALUES, width=WIDTH + 1), "view 0: expected factors of 18 and 18, .* got 6 and 45"),
        (
            btf_bytes.pvf(VALUES[:18], views=btf_bytes.VIEWS[:3]).replace(b"\x63\0\0\0\3", b"\x63\0\0\0\4"),
            "lists 3 views",
        ),
        (btf_bytes.dfmf(VALUES, model=5), r"colour model 5 \(spectral\)"),
        (btf_bytes.dfmf(VALUES[..., :1]), "expected 3 channels, got 1"),
        (btf_bytes.fmf(VALUES, **EXTENDED, extended=b"\3"), "extended header of version 0 to 2, got 3"),
        (btf_bytes.header(FMF) + struct.pack("<IB", 1, 3), "scalars of 2, 4 or 8 bytes, got 3"),
        (btf_bytes.header(FMF) + struct.pack("<IBIII", 1, 4, 0, 72, 15), "at least one component, got none"),
        (btf_bytes.fmf(VALUES)[:-1], "bytes of S V of the factorisation at byte"),
        (btf_bytes.fmf(VALUES) + b"\0", "header says 11211 bytes, file holds 11212"),
    ],
)
def test_sizes_that_do_not_agree(tmp_path, raw, text):
    with pytest.raises(FormatError, match=text):
        survey(tmp_path, raw)


def test_an_extended_header_may_say_nothing(tmp_path):
    for extended, name in ((b"\0", "RGB"), (struct.pack("<BI", 1, 0), "RGB"), (struct.pack("<BI", 1, 1), "log RGB")):
        assert survey(tmp_path, btf_bytes.fmf(VALUES, **EXTENDED, extended=extended)).colour.name == name

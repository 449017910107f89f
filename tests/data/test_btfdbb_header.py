import struct

import numpy as np
import pytest

from tests.data import btf_bytes
from torchmeso.data import btfdbb_header
from torchmeso.data.btfdbb_header import Cursor
from torchmeso.errors import FormatError


def read(raw):
    return btfdbb_header.read(Cursor("a.btf", np.frombuffer(raw, np.uint8)))


@pytest.mark.parametrize("version", [1, 2, 3, 4])
@pytest.mark.parametrize("signature", [s.decode() for s in btfdbb_header.SIGNATURES])
def test_every_signature_and_version(signature, version):
    found = read(btf_bytes.header(signature, version, channels=("r", "g", "b"), cosine=0))
    assert (found.signature, found.version) == (signature, version)
    assert found.setup == ("dome", "camera", "lamp")
    assert (found.ppmm, found.rgb_scale) == (12.5, (1.0, 2.0, 3.0))
    assert found.cosine is (None if version < 2 else False)
    assert found.xml == ("" if version < 3 else "<xml/>")
    assert found.channels == (("R", "G", "B") if version < 4 else ("r", "g", "b"))
    np.testing.assert_allclose(np.degrees(found.views), btf_bytes.VIEWS, atol=1e-4)
    np.testing.assert_allclose(np.degrees(found.lights), btf_bytes.LIGHTS, atol=1e-4)
    assert (found.width, found.height, found.texels, found.pairs) == (5, 3, 15, 24)
    assert found.rotations.shape == ((2, 3, 3) if signature.endswith("R") else (0, 3, 3))


@pytest.mark.parametrize("signature", ["!DFMF08FCR", "!FMF06FC", "!BDIF06R2!"])
def test_bytes_are_those_of_the_description(signature):
    raw = btf_bytes.header(signature)
    assert btfdbb_header.to_bytes(read(raw)) == raw


def damaged(old, new):
    raw = btf_bytes.header("!FMF06FC")
    assert old in raw
    return raw.replace(old, new)


@pytest.mark.errors
@pytest.mark.parametrize(
    ("raw", "text"),
    [
        (b"", r"expected a Bonn BTF .* got b''"),
        (b"!BDIF06R", "expected a Bonn BTF"),
        (btf_bytes.header("!FMF06FC")[:40], "expected 80 bytes of measurement setup at byte 16, the file ends after"),
        (damaged(b"<xml/>", b"<xm/>"), "expected 1 to 4096 channels, got 16777216"),
        (btf_bytes.header("!FMF06FC", 3).replace(b"\3\0\0\0dome", b"\2\0\0\0dome"), "header says it has 278 bytes"),
        (btf_bytes.header("!FMF06FC", channels=()), "expected 1 to 4096 channels, got 0"),
        (btf_bytes.header("!FMF06FC", views=[]) + bytes(12), "at least one view and light, got 0"),
        (btf_bytes.header("!FMF06FC", lights=[]), "at least one view and light, got 4 and 0"),
        (btf_bytes.header("!FMF06FC", width=0), "expected at least one texel, got 0 x 3"),
        (damaged(struct.pack("<ffI", *np.radians((30, 120)), 6), struct.pack("<ffI", 0, 0, 5)), "the same lights"),
    ],
)
def test_damage_is_named(raw, text):
    with pytest.raises(FormatError, match=f"a.btf: .*({text})"):
        read(raw)

import math
from contextlib import suppress

import pytest
import torch

from torchmeso.data import eigen_btf, store, transform_btf
from torchmeso.data.transform_btf import TransformBtf, cosines, packed, unpacked
from torchmeso.errors import FormatError, MesoError, ShapeError
from torchmeso.geometry import hemisphere

LIGHTS, VIEWS = hemisphere.grid(4, 3, 80), hemisphere.grid(5, 2, 75)


def basis(n, m, rng):
    return torch.linalg.qr(torch.randn(n, n, generator=rng)).Q[:, :m].half().float()


@pytest.fixture
def model(rng):
    return TransformBtf(
        codes=(4 * torch.randn(4, 5, 3, 6, 8, generator=rng)).round().to(torch.int16),
        light_basis=basis(12, 5, rng),
        view_basis=basis(10, 4, rng),
        colour_basis=basis(3, 3, rng),
        step=0.01,
        lights=LIGHTS,
        views=VIEWS,
    )


def test_cosines_are_orthonormal_and_come_back(rng):
    x = torch.randn(3, 48, 7, generator=rng, dtype=torch.float64)
    y = cosines(x)
    torch.testing.assert_close(y.norm(), x.norm(), rtol=1e-12, atol=0)
    torch.testing.assert_close(cosines(y, inverse=True), x, rtol=0, atol=1e-12)
    flat = cosines(torch.ones(1, 8, 8))
    assert flat[0, 0, 0] == pytest.approx(8) and flat.abs().sum() == pytest.approx(8, abs=1e-4)


def test_codes_come_back_from_their_stream(rng):
    codes = (300 * torch.randn(3, 3, 5, 4, generator=rng)).round().to(torch.int16)
    codes[0, 0, 0, :2] = torch.tensor([32000, -32000])
    assert torch.equal(unpacked(packed(codes), (3, 3, 5, 4)), codes)


def test_zeros_take_next_to_no_room():
    assert len(packed(torch.zeros(81, 3, 64, 64, dtype=torch.int16))) < 1000


def test_expanded_is_the_formula(model):
    T = cosines(torch.einsum(
        "kjchw,lj,vk,rc->lvrhw", model.codes.float() * model.step, model.light_basis, model.view_basis,
        model.colour_basis,
    ), inverse=True)  # fmt: skip
    shown = torch.einsum("lhwkr,vk->lvrhw", model.expanded().decoded(), model.expanded().weights)
    torch.testing.assert_close(shown, T, rtol=0, atol=4e-3)  # measured 7e-4: half of 1 / 255 of each component


def test_saved_and_loaded(model, tmp_path):
    path = tmp_path / "a.meso"
    transform_btf.save(model, path)
    back = transform_btf.load(path)
    assert torch.equal(back.codes, model.codes) and back.step == model.step
    assert torch.equal(back.expanded().maps, model.expanded().maps)
    few = transform_btf.load(path, rank=2)
    assert torch.equal(few.expanded().maps, model.expanded().maps[..., :2, :])


@pytest.mark.errors
@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"step": 0.0}, "expected a positive number"),
        ({"step": math.nan}, "expected a positive number"),
        ({"codes": torch.zeros(4, 5, 3, 0, 8, dtype=torch.int16)}, "at least one of each"),
        ({"light_basis": torch.full((12, 5), math.nan)}, "light_basis"),
    ],
)
def test_parts_that_do_not_match_are_refused(model, change, text):
    parts = {name: getattr(model, name) for name in TransformBtf.__dataclass_fields__}
    with pytest.raises(ShapeError, match=text):
        TransformBtf(**{**parts, **change})


@pytest.mark.errors
def test_other_models_are_refused(model, tmp_path):
    eigen_btf.save(model.expanded(), tmp_path / "b.meso")
    with pytest.raises(FormatError, match="expected a transform-coded BTF"):
        transform_btf.load(tmp_path / "b.meso")
    transform_btf.save(model, tmp_path / "a.meso")
    with pytest.raises(FormatError, match="at least one component"):
        transform_btf.load(tmp_path / "a.meso", rank=0)


@pytest.mark.errors
@pytest.mark.parametrize("shape", [(3, 3, 5, 5), (3, 3, 5, 3), (0, 3, 5, 4), (1 << 40, 3, 1 << 40, 4)])
def test_streams_of_another_size_are_refused(shape, tmp_path):
    stream = packed(torch.ones(3, 3, 5, 4, dtype=torch.int16))
    with pytest.raises(FormatError), store.reading(tmp_path):
        unpacked(stream, shape)


@pytest.mark.errors
def test_damaged_streams_are_refused():
    with pytest.raises(FormatError, match="a stream is damaged"):
        unpacked(b"\xff" * 40, (3, 3, 5, 4))


@pytest.mark.errors
def test_damaged_files_raise_only_our_errors(model, tmp_path, rng):
    path = tmp_path / "a.meso"
    transform_btf.save(model, path)
    whole = path.read_bytes()
    for n in range(300):
        data = bytearray(whole)
        if n % 3 == 0:
            data = data[: int(torch.randint(len(whole), (1,), generator=rng))]
        for place in torch.randint(len(whole), (3,), generator=rng).tolist():
            if place < len(data):
                data[place] = int(torch.randint(256, (1,), generator=rng))
        path.write_bytes(bytes(data))
        with suppress(MesoError):
            transform_btf.load(path)

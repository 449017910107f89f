import re
from contextlib import contextmanager
from pathlib import Path
from random import Random

import numpy as np
import pytest
import torch

from tests.data import btf_bytes
from tests.data.btf_bytes import HEIGHT, KINDS, LIGHTS, TEXELS, VIEWS
from tests.tolerances import BONN_PARTS
from torchmeso.data import btfdbb
from torchmeso.data.btfdbb_colour import Colour, from_rgb
from torchmeso.errors import ConfigError, FormatError, MesoError, ShapeError, SizeError

VALUES = btf_bytes.random_values()
TABLE = torch.from_numpy(btf_bytes.as_table(VALUES)).float()


def half_ulp(values):
    """One unit in the last place of a half at each value."""
    return torch.from_numpy(np.spacing(values.abs().half().numpy())).double()


def write(path, raw):
    (path / "a.btf").write_bytes(raw)
    return path / "a.btf"


def numbers(colour):
    """VALUES in the numbers of a colour model."""
    return from_rgb(colour, torch.from_numpy(VALUES)).numpy()


TRANSFORM = ((0.6, 0.6, 0.5), (0.7, -0.7, 0.0), (0.4, 0.4, -0.8))
PCA = Colour(3, (0.25, 0.5, 0.125), tuple(np.float32(TRANSFORM).ravel().tolist()))
MADE = {
    "model 0": lambda: btf_bytes.dfmf(VALUES),
    "model 0, rows are texels": lambda: btf_bytes.dfmf(VALUES, transposed=True),
    "model 0, float32": lambda: btf_bytes.dfmf(VALUES, size=4),
    "model 3": lambda: btf_bytes.dfmf(numbers(PCA), model=3, mean=PCA.mean, transform=TRANSFORM),
    **{f"model {n}": lambda n=n: btf_bytes.dfmf(numbers(Colour(n)), model=n) for n in (1, 2, 4, 9, 11, 12)},
    "fmf": lambda: btf_bytes.fmf(VALUES),
    "fmf without rotations": lambda: btf_bytes.fmf(VALUES, signature="!FMF06FC"),
    "fmf of logarithms": lambda: btf_bytes.fmf(np.log(VALUES + 1e-5), signature="!FMF12FCER", extended=b"\1\1\0\0\0"),
    "pvf": lambda: btf_bytes.pvf(VALUES),
    "pvf over lights, magic": lambda: btf_bytes.pvf(VALUES, signature="!PVF06FCR", pictures=False, legacy=True),
    "bdi": lambda: btf_bytes.bdi(VALUES),
    "bdi through bzip": lambda: btf_bytes.bdi(VALUES, compression=1),
}


@pytest.mark.parametrize("kind", MADE)
def test_values_are_kept_to_one_ulp_of_half(tmp_path, kind):
    """Highlights of 40 among them: nothing is clamped."""
    found = btfdbb.load(write(tmp_path, MADE[kind]()))
    assert found.lights.name == "rings(20: 2 @ 10, 60: 4)"
    assert found.views.name == "rings(0: 1, 30: 3)"
    assert found.texels == (3, 5)
    rows = found.rows(0, HEIGHT)
    assert float(rows.max()) > 30
    assert bool(((rows.double() - TABLE.double()).abs() <= half_ulp(TABLE)).all())
    torch.testing.assert_close(found.rows(1, 2), rows[:, :, 1:2], **BONN_PARTS)
    torch.testing.assert_close(found.picture(3, 2), rows[3, 2], **BONN_PARTS)
    assert found.rows(2, 99).shape[2] == 1
    assert found.rows(2, 2).shape == (6, 4, 0, 5, 3)
    assert torch.equal(btfdbb.read(tmp_path / "a.btf").images, rows)


def test_the_bottom_row_comes_first_in_the_file(tmp_path):
    values = np.zeros_like(VALUES)
    values[:, :5] = 1
    found = btfdbb.load(write(tmp_path, btf_bytes.bdi(values)))
    assert found.picture(0, 0)[:, 0, 0].tolist() == [0, 0, 1]


def test_directions_come_in_the_order_of_their_rings(tmp_path):
    """The file lists them backwards; the light of a texel is told by its value."""
    lights, views = LIGHTS[::-1], VIEWS[::-1]
    values = np.zeros((len(views), len(lights), TEXELS, 3))
    values += np.arange(len(lights))[None, :, None, None] + 10 * np.arange(len(views))[:, None, None, None]
    raw = btf_bytes.bdi(values.reshape(-1, TEXELS, 3), lights=lights, views=views)
    found = btfdbb.load(write(tmp_path, raw))
    rows = found.rows(0, 3)[:, :, 0, 0, 0]
    expected = torch.tensor([[(5 - l) + 10 * (3 - v) for v in range(4)] for l in range(6)])
    # Rings are sorted by theta, and on the ring by azimuth, which is how LIGHTS and VIEWS stand.
    assert torch.equal(rows, expected.float())
    assert [float(found.picture(l, 1)[0, 0, 0]) for l in range(6)] == expected[:, 1].tolist()


def test_the_cosine_flag(tmp_path):
    cosine = torch.tensor([np.cos(np.radians(theta)) for theta, _ in LIGHTS]).float()[:, None, None, None, None]

    def rows(cosine=None, **about):
        return btfdbb.load(write(tmp_path, btf_bytes.bdi(VALUES, **about)), cosine=cosine).rows(0, 3)

    held = rows()
    torch.testing.assert_close(held, TABLE, rtol=1e-3, atol=0)
    torch.testing.assert_close(rows(cosine=None), held)
    assert torch.equal(rows(version=1), held)  # too old to tell
    path = write(tmp_path, btf_bytes.header("!BDIF06R2!", cosine=0) + btf_bytes.bdi(VALUES)[len(HEAD) :])
    torch.testing.assert_close(btfdbb.load(path).rows(0, 3), held * cosine)
    torch.testing.assert_close(btfdbb.load(path).picture(5, 1), held[5, 1] * cosine[5, 0, 0])
    assert torch.equal(btfdbb.load(path, cosine=True).rows(0, 3), held)
    torch.testing.assert_close(rows(cosine=False), held * cosine)


HEAD = btf_bytes.header("!BDIF06R2!")


@pytest.mark.errors
def test_refusals(tmp_path):
    with pytest.raises(FormatError, match="found none; check the path"):
        btfdbb.load(tmp_path / "none.btf")
    path = write(tmp_path, btf_bytes.dfmf(VALUES))
    with pytest.raises(ConfigError, match="rank: expected a value from 1"):
        btfdbb.load(path, rank=0)
    with pytest.raises(ConfigError, match="picture: light: expected a value from 0 to 5"):
        btfdbb.load(path).picture(6, 0)
    with pytest.raises(SizeError, match=r"a\.btf: needs 4.2 KiB of memory, .* read it in bands"):
        btfdbb.read(path, limit=1000)
    scattered = [(10.0, 0.0), (40.0, 5.0), (40.0, 20.0), (40.0, 90.0), (60.0, 0.0), (70.0, 3.0)]
    path = write(tmp_path, btf_bytes.dfmf(VALUES, lights=scattered))
    with pytest.raises(FormatError, match=r"a\.btf: lights: expected 6 directions on rings .* resample it"):
        btfdbb.load(path)
    assert btfdbb.survey(path).header.pairs == 24


@pytest.mark.errors
def test_bands_beyond_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(btfdbb, "MEMORY_LIMIT", 1000)
    with pytest.raises(SizeError, match=r"rows 0 to 3: .* read fewer rows at a time"):
        btfdbb.load(write(tmp_path, btf_bytes.dfmf(VALUES))).rows(0, 3)


@pytest.mark.errors
def test_values_that_are_no_light(tmp_path):
    for raw in (btf_bytes.bdi(np.where(VALUES > 39, np.nan, VALUES)), btf_bytes.dfmf(VALUES * 100, model=12)):
        found = btfdbb.load(write(tmp_path, raw))
        with pytest.raises(ShapeError, match=r"a\.btf: values: expected finite values"):
            found.rows(0, 3)
        with pytest.raises(ShapeError, match=r"a\.btf: values: expected finite values"):
            [found.picture(l, v) for l in range(6) for v in range(4)]


def use(path):
    """Do with a file whatever can be done; return whether it was whole."""
    try:
        file = btfdbb.survey(path)
        file.body.facts()
        found = btfdbb.load(path)
        found.rows(0, 1)
        found.picture(len(found.lights) - 1, 0)
    except MesoError:
        return False
    return True


@pytest.mark.parametrize("kind", KINDS)
def test_truncated_files_leave_only_our_errors(tmp_path, kind):
    raw = KINDS[kind](VALUES)
    for part in range(64):
        assert not use(write(tmp_path, raw[: len(raw) * part // 64]))
    assert use(write(tmp_path, raw))


def damage(raw, random):
    """Change up to four bytes, or a whole number, most of them where the header is."""
    head = raw.find(b"<xml/>") + 400
    raw = bytearray(raw)
    for _ in range(random.randint(1, 4)):
        at = random.randrange(min(head, len(raw)) if random.random() < 0.9 else len(raw))
        if random.random() < 0.5:
            raw[at] = random.randrange(256)
        else:
            word = random.choice([0, 1, 0x7F, 0xFF, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, random.getrandbits(32)])
            raw[at : at + 4] = word.to_bytes(4, "little")
    return bytes(raw)


@contextmanager
def little_memory(limit=64 << 20):
    """Fail where the process grows by more than `limit` bytes at any time; nothing is measured off Linux."""
    status = Path("/proc/self/status")
    if not status.exists():
        yield
        return
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    before = peak(status)
    yield
    assert peak(status) - before < limit


def peak(status):
    return 1024 * int(re.search(r"VmHWM:\s+(\d+)", status.read_text())[1])


def mutate(path, count, seed):
    """Use `count` damaged files of all kinds; return how many were still whole."""
    whole, passed = [make(VALUES) for make in KINDS.values()], 0
    use(write(path, whole[0]))
    with little_memory():
        for number in range(count):
            passed += use(write(path, damage(whole[number % len(whole)], Random(seed + number))))
    return passed


@pytest.mark.filterwarnings("ignore:overflow|invalid:RuntimeWarning")
def test_a_thousand_damaged_headers_leave_only_our_errors(tmp_path):
    assert 0 < mutate(tmp_path, 1000, 0) < 900


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:overflow|invalid:RuntimeWarning")
def test_a_hundred_thousand_damaged_headers_leave_only_our_errors(tmp_path):
    assert mutate(tmp_path, 100_000, 1000) > 0


def test_a_hostile_header_takes_no_memory(tmp_path):
    """Every whole number of every header set to the largest."""
    for make in KINDS.values():
        raw = make(VALUES)
        use(write(tmp_path, raw))
        after_texts = raw.index(b"lamp") + 80
        with little_memory():
            for at in [*range(8, 20), *range(after_texts, 400, 7)]:
                use(write(tmp_path, raw[:at] + b"\xff" * 4 + raw[at + 4 :]))

import numpy as np
import pytest
import torch
from PIL import Image

from torchmeso.cli import main
from torchmeso.data import hsh, image, ptm, rti
from torchmeso.data.address import texel_centres
from torchmeso.data.rti import LightSet
from torchmeso.errors import ConfigError
from torchmeso.geometry import hemisphere
from torchmeso.pipeline import relight


@pytest.fixture(params=["png", "tif"])
def dome(tmp_path, request):
    """A set of pictures of a grey plane that leans a little, under 30 lights; T of each."""
    w = hemisphere.grid(6, 5, 65).directions()
    n = torch.nn.functional.normalize(torch.tensor([0.2, -0.1, 1.0]), dim=0)
    T = 0.6 * (w @ n).clamp(min=0)
    for k, value in enumerate(T):
        codes = image.encode_codes(value.expand(4, 5, 3))
        Image.fromarray(np.asarray(codes)).save(tmp_path / f"{k}.{request.param}")
    files = tuple(tmp_path / f"{k}.{request.param}" for k in range(len(T)))
    rti.write(LightSet(files=files, directions=w), tmp_path / "set.lp")
    return tmp_path / "set.lp", w, T


@pytest.mark.parametrize(
    ("options", "suffix", "read"),
    [
        (["ptm"], "ptm", ptm.read),
        (["ptm", "--per-channel"], "ptm", ptm.read),
        (["hsh", "--terms", "4"], "rti", hsh.read),
    ],
)
def test_a_set_becomes_a_map_on_the_command_line(dome, capsys, options, suffix, read):
    path, w, T = dome
    out = path.parent / f"a.{suffix}"
    main(["compress", str(path), "--method", *options, "--out", str(out)], standalone_mode=False)
    assert capsys.readouterr().out == f"{out}\n"
    shown = read(out).evaluate(texel_centres(4, 5)[1, 2].expand(len(w), 2), w)
    off = (image.to_srgb(shown.clamp(max=1)) - image.to_srgb(T[:, None])).square().mean().sqrt() * 255
    assert off < 12, off  # measured 5.0, 5.0 and 6


def test_a_set_of_tiff_pictures_is_described(dome, capsys):
    main(["info", str(dome[0])], standalone_mode=False)
    assert "lights: 30" in capsys.readouterr().out


@pytest.mark.errors
@pytest.mark.parametrize(
    ("name", "out", "options", "message"),
    [
        ("a.btf.zarr", "a.ptm", {"method": "ptm"}, "expected a set of pictures under known lights"),
        ("a.lp", "a.ptm", {"method": "hsh"}, "expected a name that ends in .rti"),
        ("a.lp", "a.ptm", {"method": "ptm", "terms": 9}, "ptm has no --terms"),
        ("a.lp", "a.rti", {"method": "hsh", "per_channel": True}, "hsh has no --per-channel"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, name, out, options, message):
    with pytest.raises(ConfigError, match=message):
        relight.fit(tmp_path / name, tmp_path / out, **options)


@pytest.mark.errors
def test_dials_of_other_methods_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit) as left:
        main(["compress", "a.lp", "--method", "ptm", "--rank", "4", "--out", str(tmp_path / "a.ptm")])
    assert left.value.code == 2
    assert "--method ptm has no --rank" in capsys.readouterr().err

import re

import numpy as np
import pytest
import torch

from tests.data.bonn import LIGHTS, VIEWS
from torchmeso.data import btf as btf_module
from torchmeso.data import exr_stack, image, picture_set
from torchmeso.data.btf import Btf
from torchmeso.errors import FormatError
from torchmeso.geometry import gaps, hemisphere


def random_btf(rng, lights=LIGHTS, views=VIEWS):
    images = torch.rand(len(lights), len(views), 5, 4, 3, generator=rng) * 40
    return Btf(images=images, lights=lights, views=views)


def test_a_stack_comes_back_bit_for_bit(tmp_path, rng):
    table = random_btf(rng)
    exr_stack.write(table, tmp_path / "stack")
    found = exr_stack.survey(tmp_path / "stack")
    assert (found.lights, found.views, found.encoding) == (LIGHTS, VIEWS, "linear")
    assert torch.equal(picture_set.read(found).images, table.images)
    assert not list(tmp_path.glob("*.part"))


def test_rings_with_uneven_angles_come_back(tmp_path, rng):
    lights, views = hemisphere.grid(7, 3, 80), hemisphere.from_rings((23.5,), (1,), (7.5,))
    exr_stack.write(random_btf(rng, lights, views), tmp_path / "stack")
    found = exr_stack.survey(tmp_path / "stack")
    torch.testing.assert_close(found.lights.directions(), lights.directions(), rtol=0, atol=1e-6)
    assert (found.lights.count, found.views) == (lights.count, views)


def test_tables_of_codes_are_written_as_linear_pictures(tmp_path, rng):
    codes = torch.randint(0, 256, (7, 4, 2, 3, 3), generator=rng, dtype=torch.uint8)
    table = Btf(images=codes, lights=LIGHTS, views=VIEWS, encoding="srgb")
    exr_stack.write(table, tmp_path / "stack")
    assert torch.equal(picture_set.read(exr_stack.survey(tmp_path / "stack")).images, image.decode_codes(codes))


def test_a_folder_that_stood_there_is_replaced_whole(tmp_path, rng):
    (tmp_path / "stack").mkdir()
    (tmp_path / "stack" / "old.exr").touch()
    (tmp_path / "stack.part").mkdir()
    exr_stack.write(random_btf(rng), tmp_path / "stack")
    assert len(list((tmp_path / "stack").iterdir())) == 7 * 4 + 1


def test_stacks_by_others(tmp_path):
    """Columns in another order, names in folders, an azimuth beyond the full turn, lines missing."""
    lines = ["phi_o_deg,theta_o_deg,note,file,theta_i_deg,phi_i_deg"]
    for l, (theta, phi) in enumerate(gaps.angles_deg(LIGHTS)):
        if l != 3:
            (tmp_path / "a b").mkdir(exist_ok=True)
            image.write_exr(tmp_path / "a b" / f"{l}.exr", torch.full((2, 2, 3), float(l)))
            lines.append(f'0,0,"x, y",a b/{l}.exr,{theta},{phi + 360}')
    (tmp_path / "directions.csv").write_text("\r\n".join(lines))
    found = exr_stack.survey(tmp_path)
    assert found.missing_text() == "1 of 7 (tl040 pl120 tv000 pv000)"
    assert picture_set.read(found, allow_missing=True).images[:3, 0, 0, 0, 0].tolist() == [0, 1, 2]


def test_one_view_alone_is_read(tmp_path, rng):
    table = random_btf(rng)
    btf_module.save(table, tmp_path / "a.btf.zarr", dtype="float32")
    assert torch.equal(btf_module.load(tmp_path / "a.btf.zarr").seen_from(2), table.images[:, 2])


@pytest.mark.errors
def test_damaged_tables_are_named(tmp_path, rng):
    with pytest.raises(FormatError, match="expected a table of directions, found none; its columns are file, theta_i"):
        exr_stack.survey(tmp_path)
    path = tmp_path / "directions.csv"
    header = "file,theta_i_deg,phi_i_deg,theta_o_deg,phi_o_deg\n"
    path.write_text(header)
    with pytest.raises(FormatError, match="expected a line for each picture, found none"):
        exr_stack.survey(tmp_path)
    path.write_text(header + "a.exr,1,2,3\n")
    with pytest.raises(FormatError, match="found no 'phi_o_deg'"):
        exr_stack.survey(tmp_path)
    path.write_text(header + "a.exr,1,2,x,3\n")
    with pytest.raises(FormatError, match=r"cannot be read \(ValueError: could not convert string to float"):
        exr_stack.survey(tmp_path)
    for name in ("a.exr", "../b.exr"):
        (tmp_path.parent / "b.exr").touch()
        path.write_text(header + f"{name},0,0,0,0\n")
        with pytest.raises(FormatError, match=rf"names the picture '{re.escape(name)}', of which there is none in"):
            exr_stack.survey(tmp_path)
    path.write_text(header + "a\0.exr,0,0,0,0\n")
    with pytest.raises(FormatError, match=r"cannot be read|names the picture"):  # no path may hold it
        exr_stack.survey(tmp_path)
    (tmp_path / "a.exr").touch()
    path.write_text(header + "a.exr,nan,0,0,0\n")
    with pytest.raises(FormatError, match=r"expected polar angles .* got theta nan, phi 0"):
        exr_stack.survey(tmp_path)


@pytest.mark.errors
def test_an_exr_that_announces_too_much_is_refused(tmp_path):
    image.write_exr(tmp_path / "a.exr", torch.zeros(4, 4, 3))
    data = (tmp_path / "a.exr").read_bytes()
    window = np.array([0, 0, 3, 3], "<i4").tobytes()
    (tmp_path / "a.exr").write_bytes(data.replace(window, np.array([0, 0, 99999, 99999], "<i4").tobytes()))
    with pytest.raises(FormatError, match="announces 100000 x 100000 pixels in"):
        image.read(tmp_path / "a.exr")

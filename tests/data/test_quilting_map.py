from dataclasses import replace

import pytest
import torch

from tests.synthesize import looks
from torchmeso.data import quilting_map, store
from torchmeso.data.mdf import Mdf
from torchmeso.data.pyramid import footprint
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.data.relief import Relief
from torchmeso.data.textured import Textured
from torchmeso.errors import FormatError, ShapeError
from torchmeso.geometry import hemisphere
from torchmeso.geometry.directions import from_angles
from torchmeso.synthesize.patch_error import exemplar
from torchmeso.synthesize.quilting import QuiltingOptions, grow


def make(rng, size=(5, 7), source=(3, 4), **more):
    index = torch.randint(0, source[0] * source[1], size, generator=rng, dtype=torch.int32)
    return QuiltingMap(index=index, source=source, **more)


def test_apply_puts_the_exemplars_texels_where_the_map_says(rng):
    quilting = make(rng)
    x = torch.rand(2, 3, 4, 6, generator=rng)
    found = quilting.apply(x, 1)
    assert found.shape == (2, 5, 7, 6)
    for row, column in [(0, 0), (4, 6), (2, 3)]:
        at = int(quilting.index[row, column])
        assert found[:, row, column].equal(x[:, at // 4, at % 4])


def test_texture_coordinates_stay_those_of_the_exemplar(rng):
    assert make(rng).periods == (7 / 4, 5 / 3)


def test_seams_are_where_neighbours_are_not(rng):
    index = torch.arange(12, dtype=torch.int32).reshape(3, 4)
    right, below = QuiltingMap(index=index, source=(3, 4), tileable=True).seams()
    assert not right.any() and not below.any()
    moved = QuiltingMap(index=torch.cat([index[:, :2], index[:, :2]], 1).contiguous(), source=(3, 4))
    right, below = moved.seams()
    assert right.nonzero().tolist() == [[0, 1], [1, 1], [2, 1]] and not below.any()
    right, _ = QuiltingMap(index=moved.index, source=(3, 4), tileable=True).seams()
    assert right[:, 3].all()


@pytest.mark.parametrize(("source", "n_bytes"), [((3, 4), 2), ((200, 300), 4)])
def test_files_keep_the_map_in_at_most_four_bytes_a_texel(source, n_bytes, rng, tmp_path):
    quilting = make(rng, size=(64, 64), source=source, tileable=True)
    path = tmp_path / "a.quilt"
    quilting_map.save(quilting, path, seed=3)
    found = quilting_map.load(path)
    assert found.index.equal(quilting.index) and found.source == source and found.tileable
    assert path.stat().st_size < n_bytes * 64 * 64 + 500
    about = quilting_map.describe(path)
    assert about["texels"] == "64 x 64" and about["seed"] == 3


@pytest.mark.errors
def test_bad_maps_are_named(rng, tmp_path):
    index = torch.zeros(2, 2, dtype=torch.int32)
    with pytest.raises(ShapeError, match="expected texels from 0 to 11, got 12"):
        QuiltingMap(index=index + 12, source=(3, 4))
    with pytest.raises(ShapeError, match="expected texels from 0 to 11, got -1"):
        QuiltingMap(index=index - 1, source=(3, 4))
    with pytest.raises(ShapeError, match="expected int32"):
        QuiltingMap(index=index.long(), source=(3, 4))
    with pytest.raises(ShapeError, match="expected at least one texel from an exemplar of at most 32768"):
        QuiltingMap(index=index, source=(1, 40000))
    with pytest.raises(ShapeError, match="expected the exemplar's 4 x 3 texels, got 3 x 4"):
        make(rng).apply(torch.zeros(4, 3))
    with pytest.raises(FormatError, match="none; make one with torchmeso synthesize"):
        quilting_map.load(tmp_path / "b.quilt")
    store.write_model(tmp_path / "c.quilt", {"x": index}, {"kind": "eigen"})
    with pytest.raises(FormatError, match=r"expected a quilting map \(\.quilt\), got a file of kind 'eigen'"):
        quilting_map.load(tmp_path / "c.quilt")
    store.write_model(tmp_path / "d.quilt", {"quilting.index": index + 9}, {"quilting": {"source": [1, 2]}})
    with pytest.raises(FormatError, match="tileable"):
        quilting_map.load(tmp_path / "d.quilt")


def laid(rng, source):
    """A map of whole and cut patches, and texture coordinates over several of its periods."""
    index = torch.randint(0, source[0] * source[1], (9, 11), generator=rng, dtype=torch.int32)
    quilting = QuiltingMap(index=index, source=source, tileable=True)
    uv = 8 * torch.rand(200, 2, generator=rng) - 3
    return quilting, uv, uv / torch.tensor(quilting.periods)


def upper(n, rng):
    return from_angles(1.5 * torch.rand(n, generator=rng), 6 * torch.rand(n, generator=rng))


@pytest.mark.parametrize(("kind", "rows"), [(looks.eigen, 1), (looks.sh_pca, 1), (looks.double_sh, 2)])
def test_a_quilted_btf_is_the_btf_of_the_texels_the_map_names(kind, rows, rng):
    model = kind(rng)
    quilting, uv, uv_whole = laid(rng, model.texels)
    quilted, whole = replace(model, quilting=quilting), replace(model, maps=quilting.apply(model.maps, rows))
    wi, wo = upper(200, rng), upper(200, rng)
    torch.testing.assert_close(quilted.evaluate(uv, wi, wo), whole.evaluate(uv_whole, wi, wo), rtol=1e-4, atol=2e-4)
    torch.testing.assert_close(quilted.ambient(uv, wo), whole.ambient(uv_whole, wo), rtol=1e-4, atol=2e-4)
    small = quilted.truncated(4, 4) if kind is looks.double_sh else quilted.truncated(2)
    assert small.quilting is quilting


def test_a_quilted_mdf_is_the_mdf_of_the_texels_the_map_names(rng):
    directions = hemisphere.grid(6, 3, 87.5)
    delta = torch.rand(len(directions), 8, 12, generator=rng)
    no_hit = torch.rand(delta.shape, generator=rng) < 0.2
    mdf = Mdf(delta=torch.where(no_hit, 0, delta), no_hit=no_hit, directions=directions, h=0.1)
    quilting, uv, uv_whole = laid(rng, (4, 6))  # the MDF has two texels for each of the map's

    def whole(x, finer):
        blocks = x.reshape(*x.shape[:-2], 4, finer, 6, finer).movedim(-3, -2)
        return quilting.apply(blocks, x.dim() - 2).movedim(-2, -3).flatten(-2).flatten(-3, -2)

    quilted = replace(mdf, quilting=quilting)
    large = replace(mdf, delta=whole(mdf.delta, 2), no_hit=whole(no_hit, 2))
    wo = upper(200, rng)
    torch.testing.assert_close(quilted.evaluate(uv, wo), large.evaluate(uv_whole, wo), rtol=1e-4, atol=2e-4)
    relief = quilted.relief
    fine = Relief(drop=whole(relief.drop, 8), hole=whole(relief.hole, 8), h=0.1)
    torch.testing.assert_close(quilted.depth(uv), fine.depth(uv_whole), rtol=1e-4, atol=2e-4)


def test_quilted_pictures_of_two_sizes_move_together(rng):
    pictures = Textured(albedo=torch.rand(4, 6, 3, generator=rng), normals=torch.rand(8, 12, 3, generator=rng))
    quilting, uv, uv_whole = laid(rng, (4, 6))
    blocks = pictures.normals.reshape(4, 2, 6, 2, 3).movedim(2, 1)
    normals = quilting.apply(blocks).movedim(2, 1).flatten(2, 3).flatten(0, 1)
    whole = Textured(albedo=quilting.apply(pictures.albedo), normals=normals)
    wi = upper(200, rng)
    found = replace(pictures, quilting=quilting).evaluate(uv, wi, wi)
    torch.testing.assert_close(found, whole.evaluate(uv_whole, wi, wi), rtol=1e-4, atol=2e-4)


def test_far_away_a_quilted_texture_is_nearly_as_good_as_one_with_a_pyramid_of_its_own(rng):
    picture = looks.noise(32, 32, rng)
    quilting = grow(exemplar(picture), (96, 96), QuiltingOptions(tileable=True), rng=rng).map
    quilted, whole = Textured(albedo=picture, quilting=quilting), Textured(albedo=quilting.apply(picture))
    uv, wi = 3 * torch.rand(1000, 2, generator=rng), torch.tensor([0.0, 0.0, 1.0]).expand(1000, 3)
    for texels in (2, 4, 8):
        pixel = texels / 32
        seen = [
            whole.evaluate((uv + pixel * (torch.rand(uv.shape, generator=rng) - 0.5)) / 3, wi, wi) for _ in range(99)
        ]
        mean = torch.stack(seen).mean(0)
        a = quilted.evaluate(uv, wi, wi, footprint(wi, torch.full((1000,), pixel)))
        b = whole.evaluate(uv / 3, wi, wi, footprint(wi, torch.full((1000,), pixel / 3)))
        error = [10 * float((x - mean).square().mean().log10()) for x in (a, b)]
        assert error[0] < error[1] + 4  # dB; measured 3.2 at two texels, 1.3 beyond

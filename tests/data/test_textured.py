import io

import numpy as np
import pytest
import torch
from PIL import Image

from torchmeso.data import image, textured
from torchmeso.data.btf import Evaluable
from torchmeso.data.textured import Textured
from torchmeso.errors import FormatError, ShapeError
from torchmeso.geometry import frames
from torchmeso.geometry.directions import normalize
from torchmeso.geometry.frames import Frame
from torchmeso.geometry.mesh_file import Finish


def png(pixels):
    content = io.BytesIO()
    Image.fromarray(np.array(pixels, np.uint8)).save(content, format="PNG")
    return content.getvalue()


def directions(n, rng):
    return normalize(torch.randn(n, 3, generator=rng, dtype=torch.float64))


def test_it_is_what_shading_asks():
    assert isinstance(Textured(albedo=torch.ones(1, 1, 3)), Evaluable)


def test_colours_are_decoded_once_and_interpolated_as_light():
    looks = textured.from_finish(Finish(albedo=(0.5, 1.0, 1.0), albedo_map=png([[[255, 0, 0], [188, 0, 0]]])))
    up = torch.tensor([[0.0, 0.0, 1.0]])
    half_way = looks.evaluate(torch.tensor([[0.5, 0.5]]), up, up)[0]
    expected = 0.5 * (1 + float(image.to_linear(torch.tensor(188 / 255)))) / 2
    assert half_way.tolist() == pytest.approx([expected, 0, 0])


def test_a_picture_stands_upright_and_repeats():
    """Row 0 is v near 1."""
    looks = Textured(albedo=torch.tensor([[[1.0, 0, 0]], [[0, 1.0, 0]]]))
    up = torch.tensor([0.0, 0.0, 1.0]).expand(2, 3)
    for shift in (0.0, -3.0, 100.0):
        found = looks.evaluate(torch.tensor([[0.5, 0.75], [0.5, 0.25]]) + shift, up, up)
        torch.testing.assert_close(found, torch.tensor([[1.0, 0, 0], [0, 1.0, 0]]), rtol=0, atol=1e-5)


def test_normals_lean_as_the_map_says():
    """Red leans along +u, green along +v; the scale bends both."""
    tilt = textured.from_finish(Finish(albedo=(1, 1, 1), normal_map=png([[[255, 128, 255]]]), normal_scale=0.5))
    n = tilt.normal(torch.zeros(1, 2))[0]
    assert n[0] / n[2] == pytest.approx(0.5, abs=1e-3)
    assert abs(float(n[1])) < 0.01
    green = textured.from_finish(Finish(normal_map=png([[[128, 255, 128]]]))).normal(torch.zeros(1, 2))[0]
    assert green[1] > 0.99


def test_ambient_is_the_integral_over_the_light_hemisphere(rng):
    n = normalize(torch.tensor([0.6, -0.3, 0.5]))
    looks = Textured(albedo=torch.tensor([[[0.8, 0.5, 0.2]]]), normals=n[None, None])
    wi = directions(400_000, rng)
    wi = torch.where(wi[:, 2:] < 0, -wi, wi)
    uv = torch.zeros(len(wi), 2, dtype=torch.float64)
    sampled = 2 * looks.evaluate(uv, wi, wi).mean(0)  # (1/pi) 2 pi mean
    torch.testing.assert_close(looks.ambient(uv[:1], wi[:1])[0], sampled, rtol=5e-3, atol=0)


def test_nothing_arrives_from_below():
    looks = Textured(albedo=torch.ones(1, 1, 3), normals=torch.tensor([[[1.0, 0.0, 0.2]]]))
    wi = normalize(torch.tensor([[1.0, 0.0, -0.1], [-1.0, 0.0, 0.1]]))
    assert looks.evaluate(torch.zeros(2, 2), wi, wi).tolist() == [[0, 0, 0], [0, 0, 0]]


def test_a_mirrored_texture_leans_the_mirrored_way(rng):
    """A bump seen through a mirrored map is the mirrored bump: local directions of a left-handed frame say so."""
    looks = Textured(albedo=torch.ones(1, 1, 3), normals=torch.tensor([[[0.5, 0.3, 0.8]]]))
    light = directions(100, rng)
    axes = torch.eye(3, dtype=torch.float64).expand(100, 3, 3)
    straight = Frame(axes[:, 0], axes[:, 1], axes[:, 2])
    mirror = frames.orthonormal(axes[:, 2], -axes[:, 0], -torch.ones(100, dtype=torch.float64))
    uv = torch.zeros(100, 2, dtype=torch.float64)
    flipped = light * torch.tensor([-1.0, 1.0, 1.0])
    a = looks.evaluate(uv, frames.to_local(mirror, flipped), light)
    b = looks.evaluate(uv, frames.to_local(straight, light), light)
    torch.testing.assert_close(a, b)
    assert (b > 0).any()


def test_gradients_flow():
    looks = Textured(albedo=torch.rand(4, 4, 3, dtype=torch.float64), normals=torch.rand(3, 3, 3, dtype=torch.float64))
    uv = torch.tensor([[0.3, 0.4]], dtype=torch.float64, requires_grad=True)
    wi = normalize(torch.tensor([[0.1, 0.2, 1.0]], dtype=torch.float64))
    assert torch.autograd.gradcheck(lambda x: looks.evaluate(x, wi, wi), (uv,))


@pytest.mark.errors
def test_refusals(tmp_path):
    with pytest.raises(ShapeError, match=r"textured\.albedo: expected shape \(any, any, 3\), got \(3,\)"):
        Textured(albedo=torch.ones(3))
    with pytest.raises(ShapeError, match=r"textured\.normals"):
        Textured(albedo=torch.ones(1, 1, 3), normals=torch.ones(2, 2))
    with pytest.raises(FormatError, match="embedded picture: expected a PNG, JPEG"):
        textured.from_finish(Finish(albedo_map=b"nothing"))
    with pytest.raises(FormatError, match="found none"):
        textured.from_finish(Finish(normal_map=tmp_path / "none.png"))

import torch

from torchmeso.bench import gdm_distortion


def test_a_saddle_bends_both_ways():
    """Normals lean inwards along x and outwards along z."""
    mesh = gdm_distortion.saddle(800)
    x, y, z = mesh.vertices.unbind(1)
    torch.testing.assert_close(y, 0.5 * (x.square() - z.square()))
    expected = torch.nn.functional.normalize(torch.stack([-x, torch.ones_like(x), z], 1), dim=1)
    inner = (x.abs() < 0.9) & (z.abs() < 0.9)
    assert ((mesh.normals * expected).sum(1)[inner] > 0.998).all()

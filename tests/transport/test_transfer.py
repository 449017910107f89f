import math

import numpy as np
import pytest
import torch

from torchmeso.algebra import spherical_harmonics
from torchmeso.errors import ConfigError, ShapeError, SizeError
from torchmeso.geometry import shapes
from torchmeso.geometry.directions import normalize
from torchmeso.transport import transfer
from torchmeso.transport.transfer import Bodies, TransferOptions

WHITE = torch.ones(3)


def bodies(mesh, albedo=WHITE):
    return Bodies(
        mesh.vertices.float(), mesh.faces, normalize(mesh.normals.float()), albedo.expand(len(mesh.vertices), 3)
    )


def under_a_disc(angle):
    """A point below a round plate that it sees under the half angle `angle`."""
    phi = torch.linspace(0, 2 * math.pi, 721)[:-1]
    rim = torch.stack([math.tan(angle) * phi.cos(), math.tan(angle) * phi.sin(), torch.ones_like(phi)], -1)
    vertices = torch.cat([torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]), rim])
    k = torch.arange(720)
    faces = torch.stack([torch.ones_like(k), k + 2, (k + 1) % 720 + 2], -1)
    normals = torch.tensor([0.0, 0.0, 1.0]).expand(len(vertices), 3)
    return Bodies(vertices, faces, normals, torch.zeros(len(vertices), 3))


def of_a_cap(angle, degree):
    """Integrals of y_i y_0 over the cap around the pole: those with m = 0, by Gauss points in z."""
    nodes, weights = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(32))
    low = math.cos(angle)
    z = low + (nodes + 1) * (1 - low) / 2
    w = torch.stack([(1 - z * z).sqrt(), 0 * z, z], -1)
    y = spherical_harmonics.basis(w, degree)
    found = 2 * math.pi * (weights * (1 - low) / 2) @ y / math.sqrt(4 * math.pi)
    zonal = torch.zeros_like(found)
    for l in range(degree + 1):
        zonal[l * l + l] = found[l * l + l]
    return zonal


def test_nothing_stands_in_the_way_of_a_convex_body():
    M = transfer.bake(bodies(shapes.sphere(triangles=300)), TransferOptions(degree=4, rays=256)).matrices
    torch.testing.assert_close(M, torch.eye(25).expand_as(M), rtol=0, atol=1e-6)


@pytest.mark.parametrize("angle_deg", [15.0, 40.0, 70.0])
def test_one_occluder_takes_the_light_of_its_cap(angle_deg):
    angle = math.radians(angle_deg)
    options = TransferOptions(bounces=0)
    M = transfer.bake(under_a_disc(angle), options).matrices[0, 0].double()
    wanted = -of_a_cap(angle, options.degree)
    wanted[0] += 1
    assert float((M[:, 0] - wanted).abs().max()) < 1e-3  # measured 3.5e-4, 4.1e-4, 7.1e-4


def test_a_white_body_in_white_light_is_white_everywhere():
    mesh = shapes.torus(tube=0.45, triangles=400)
    M = transfer.bake(bodies(mesh), TransferOptions(degree=3, rays=256, bounces=24)).matrices
    e = torch.zeros(16, 3)
    e[0] = 1
    shadowed = transfer.bake(bodies(mesh), TransferOptions(degree=3, rays=256, bounces=0)).matrices[:, 0, 0, 0]
    assert float(shadowed.min()) < 0.9
    torch.testing.assert_close(M[:, 0] @ e, e.expand(len(M), -1, -1), rtol=0, atol=1e-3)


def test_a_red_neighbour_lends_its_colour():
    floor, wall = shapes.plane(size=(2.0, 2.0)), shapes.plane(size=(2.0, 2.0))
    up = wall.vertices[:, [1, 0, 2]].clone()  # stands at x = 0, looks towards +x
    up[:, 0] = -0.5
    vertices = torch.cat([floor.vertices, up + torch.tensor([0.0, 1.0, 0.0])])
    normals = torch.cat([floor.normals, torch.tensor([1.0, 0, 0]).expand(len(up), 3)])
    albedo = torch.cat([WHITE.expand(len(floor.vertices), 3), torch.tensor([0.8, 0.1, 0.1]).expand(len(up), 3)])
    faces = torch.cat([floor.faces, wall.faces + len(floor.vertices)])
    made = transfer.bake(Bodies(vertices, faces, normals, albedo), TransferOptions(degree=2, rays=512, bounces=1))
    e = torch.zeros(9, 3)
    e[0] = 1
    red, green, _ = made.arriving(e).at_vertices[: len(floor.vertices), 0].unbind(-1)
    assert float((red - green).max()) > 0.01 and float((red - green).min()) >= 0


def test_rays_are_the_same_for_any_order_of_bodies():
    mesh = shapes.torus(triangles=200)
    a = bodies(mesh)
    turned = Bodies(a.vertices, a.faces.flip(0), *a[2:])
    options = TransferOptions(degree=2, rays=128)
    torch.testing.assert_close(transfer.bake(a, options).matrices, transfer.bake(turned, options).matrices)


@pytest.mark.errors
def test_what_cannot_be_followed_is_refused(monkeypatch):
    with pytest.raises(ConfigError, match=r"transfer\.rays"):
        TransferOptions(rays=1)
    made = bodies(shapes.sphere(triangles=80))
    with pytest.raises(ShapeError, match="transfer: albedo"):
        transfer.bake(made._replace(albedo=torch.ones(2, 3)))
    monkeypatch.setattr(transfer, "MEMORY_LIMIT", 1000)
    with pytest.raises(SizeError, match="lower its degree"):
        transfer.bake(made)

import torch

from torchmeso.geometry import shapes, shell
from torchmeso.geometry.shell import OUTWARD
from torchmeso.render import device_shell


def built():
    mesh = shapes.torus(triangles=120, tiles=(4, 2))
    return mesh, shell.build(mesh, 0.1)


def test_a_code_leads_to_the_same_face_of_the_neighbour():
    _, own = built()
    records = device_shell.tet_records(own, first_tet=30, first_vertex=100)
    codes = torch.from_numpy(records["ahead"].astype("int64"))
    assert torch.equal(codes[own.neighbour < 0], own.neighbour[own.neighbour < 0])
    tet, corner = (own.neighbour >= 0).nonzero().unbind(1)
    code = codes[tet, corner] & 0xFFFFFFFF
    other = (code >> 10) - 30
    assert torch.equal(other, own.neighbour[tet, corner])
    assert torch.equal((code & 256) != 0, other // 3 != tet // 3)
    face = OUTWARD[corner]
    there = (code[:, None] >> (2 * face)) & 3
    assert torch.equal(own.tets[tet].gather(1, face), own.tets[other].gather(1, there))
    behind = (code >> (2 * corner)) & 3
    assert torch.equal(own.neighbour[other, behind], tet)
    seam = (own.uvz[tet[:, None], face] != own.uvz[other[:, None], there]).flatten(1).any(1)
    assert torch.equal((code & 512) != 0, seam)
    assert seam.any()
    assert (torch.from_numpy(records["vertex"]).long() == own.tets + 100).all()


def test_shares_of_a_prism_follow_its_texture_coordinates(rng):
    mesh, own = built()
    records = device_shell.prism_records(own, mesh, first_record=7)
    corner = mesh.faces[own.face]
    share = torch.rand(len(corner), 3, generator=rng, dtype=torch.float64)
    share = share / share.sum(1, keepdim=True)
    uv = (share[..., None] * mesh.uv.double()[corner]).sum(1)
    way = uv - torch.from_numpy(records["at"]).double()
    for k, name in ((1, "first"), (2, "second")):
        got = torch.from_numpy(records["base"]).double() + (way * torch.from_numpy(records[name]).double()).sum(1)
        torch.testing.assert_close(got, share[:, k], rtol=0, atol=1e-4)
    assert torch.equal(torch.from_numpy(records["corner"]).long(), corner + 7)

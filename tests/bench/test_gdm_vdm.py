import pytest
import torch

from torchmeso.bench import gdm_vdm
from torchmeso.bench.gdm_speed import view


def test_the_surfaces_of_the_paper():
    sheet, body = gdm_vdm.undulating(), gdm_vdm.vase()
    assert not sheet.closed.any()
    assert body.closed.all()
    assert len(sheet.faces) == 2592
    assert abs(len(body.faces) / 8640 - 1) < 0.05
    radius = body.vertices[:, [0, 2]].norm(dim=1)
    neck, belly = ((body.vertices[:, 1] - y).abs() < 0.05 for y in (0.5, -0.2))
    assert radius[neck].max() < 0.5 * radius[belly].max()


@pytest.mark.slow
def test_depths_that_are_true_are_judged_so():
    mesh, camera = gdm_vdm.undulating(200), view(gdm_vdm.EYES["undulating"])
    truth = gdm_vdm.true_depth(mesh, camera)
    assert 0.2 < truth.isfinite().double().mean() < 0.8
    voxel, scale = 1 / 64, float(mesh.scale.mean())
    rows = {
        r.id.split(".", 2)[2]: r.value for r in gdm_vdm.judge("a", mesh, camera, {"x": truth, "y": truth + 1}, voxel)
    }
    assert (rows["x.near"], rows["x.median"], rows["x.p95"]) == (100, 0, 0)
    assert abs(rows["y.median"] * scale * voxel - 1) < 1e-2
    torch.testing.assert_close(rows["y.near"], 100.0)

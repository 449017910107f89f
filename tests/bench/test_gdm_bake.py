from torchmeso.bench import gdm_bake
from torchmeso.bench.suite import Context
from torchmeso.meso.bake_gdm import GdmOptions


def test_every_bake_is_a_row():
    options = GdmOptions(texels=8, layers=4, n_theta=4, n_phi=6)
    rows = list(gdm_bake.bake(Context(quick=True), options))
    assert [row.id for row in rows] == ["bake.weave", "bake.grass"]
    assert all(row.value is not None and row.value > 0 for row in rows)
    assert "8 x 8 x 4 voxels, 4 x 6 directions" in rows[0].what

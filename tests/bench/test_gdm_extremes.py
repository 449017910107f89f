import pytest

from torchmeso.bench import gdm_extremes, stability
from torchmeso.errors import MesoError

FEW = (
    "height_0.001",
    "thin_tube_outward",
    "eye_in_the_grass_open",
    "one_triangle_open",
    "zero_normals",
    "mesh_duplicated_outward",
    "mesh_uv_collapsed_inward",
    "table_empty_solid",
    "table_few_directions_open",
    "far_100000",
    "part",
)


def test_names_are_unique():
    for found in (gdm_extremes.cases(16), gdm_extremes.refusals()):
        names = [c.name for c in found]
        assert len(set(names)) == len(names)


@pytest.mark.errors
@pytest.mark.parametrize("case", [*gdm_extremes.refusals()], ids=lambda c: c.name)
def test_what_is_no_shell_is_refused(case):
    with pytest.raises(MesoError):
        case.make()


@pytest.mark.parametrize("name", FEW)
def test_shells_at_the_edge(name, device):
    (case,) = [c for c in gdm_extremes.cases(32) if c.name == name]
    rows = list(stability.judge(case, "shell"))
    assert [r.id for r in rows] == [f"shell.{name}.finite", f"shell.{name}.differ"]
    assert all(r.met for r in rows), [r.to_json() for r in rows if not r.met]

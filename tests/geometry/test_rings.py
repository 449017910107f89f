import math

import pytest
import torch

from torchmeso.errors import FormatError
from torchmeso.geometry import hemisphere, rings
from torchmeso.geometry.directions import to_angles

SETS = [
    hemisphere.ubo81(),
    hemisphere.ubo151(),
    hemisphere.grid(12, 5, 80),
    hemisphere.from_rings((0, 23.5, 70), (1, 7, 1), (0, 7.5, 300)),
]


def listed(directions):
    """(n, 2) theta and phi as files keep them: float32 radians."""
    return torch.stack(to_angles(directions.directions(torch.float64)), -1).float()


@pytest.mark.parametrize("directions", SETS, ids=lambda d: d.name)
def test_a_shuffled_list_is_recognised_and_sorted(directions, rng):
    angles = listed(directions)
    shuffle = torch.randperm(len(angles), generator=rng)
    found = rings.recognise("lights", angles[shuffle])
    assert found.directions.count == directions.count
    torch.testing.assert_close(found.directions.directions(), directions.directions(), rtol=0, atol=2e-6)
    assert torch.equal(shuffle[found.order], torch.arange(len(angles)))


def test_known_sets_keep_their_names():
    assert rings.recognise("x", listed(hemisphere.ubo81())).directions == hemisphere.ubo81()
    assert rings.recognise("x", listed(hemisphere.ubo151())).directions == hemisphere.ubo151()


def test_names_are_read_back():
    name = rings.recognise("x", listed(SETS[3])).directions.name
    assert name == "rings(0: 1, 23.5: 7 @ 7.5, 70: 1 @ 300)"
    assert hemisphere.parse(name).name == name


def test_small_errors_of_a_rig_are_forgiven(rng):
    angles = listed(hemisphere.ubo81()) + 0.004 * (torch.rand(81, 2, generator=rng) - 0.5)
    angles[0, 0] = 0.001
    assert rings.recognise("x", angles).directions == hemisphere.ubo81()


def test_the_azimuth_of_the_pole_means_nothing():
    angles = listed(hemisphere.ubo81())
    angles[0, 1] = 2.5
    assert rings.recognise("x", angles).directions == hemisphere.ubo81()


def test_the_true_directions_of_the_dome(data_dir):
    xyz = torch.from_file(str(data_dir / "directions" / "xyz_loc.bin"), size=4 * 151, dtype=torch.float64)
    angles = torch.stack(to_angles(xyz.reshape(4, 151)[:3].mT), -1)
    assert rings.recognise("lights", angles).directions == hemisphere.ubo151()


@pytest.mark.errors
@pytest.mark.parametrize(
    ("angles", "text"),
    [
        ([[0.1, 0.0], [0.1, 1.0], [0.1, 2.0]], "expected 3 directions on rings of even steps, got a scattered list"),
        ([[0.5, 0.0], [0.5, 0.0]], "scattered list"),
        ([[0.0, 0.0], [0.0, 1.0]], "scattered list"),
        ([[math.nan, 0.0]], "one that is no number"),
        ([[-0.2, 0.0]], "expected polar angles from 0 to 89.9"),
        ([[math.pi / 2, 0.0]], "expected polar angles from 0 to 89.9"),
        (torch.zeros(0, 2).tolist(), "got none"),
    ],
)
def test_other_lists_are_refused(angles, text):
    with pytest.raises(FormatError, match=f"views: .*{text}"):
        rings.recognise("views", torch.tensor(angles, dtype=torch.float32).reshape(-1, 2))

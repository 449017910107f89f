import pytest
import torch

from tests.reference import patch_error as reference
from tests.synthesize import looks
from torchmeso.data import address
from torchmeso.errors import ConfigError, ShapeError
from torchmeso.geometry import hemisphere
from torchmeso.synthesize import patch_error
from torchmeso.synthesize.patch_error import Metric, Search, channels, exemplar


def between(picture, a, b):
    return (picture[a] - picture[b]).double().square().sum()


def mean_square(model, a, b):
    """Squared difference of T between two texels, over all lights, views and colours, by solid angle."""
    uv = address.texel_centres(*model.texels)
    lights, views = model.lights.directions(), model.views.directions()
    shares = [hemisphere.solid_angles(d) / hemisphere.solid_angles(d).sum() for d in (model.lights, model.views)]
    wi, wo = (x.reshape(-1, 3) for x in torch.broadcast_tensors(lights[:, None], views[None]))
    T = [model.evaluate(uv[at].expand(len(wi), 2), wi, wo).double() for at in (a, b)]
    each = (T[0] - T[1]).square().mean(-1).reshape(len(lights), len(views))
    return torch.einsum("l,v,lv->", *shares, each)


PAIRS = [((0, 0), (3, 5)), ((1, 2), (2, 2)), ((0, 5), (0, 4))]


@pytest.mark.parametrize("kind", [looks.eigen, looks.sh_pca, looks.double_sh])
def test_distance_of_channels_is_the_mean_square_over_lights_views_and_colours(kind, rng):
    model = kind(rng)
    found = channels(model)
    for a, b in PAIRS:
        assert between(found, a, b) == pytest.approx(float(mean_square(model, a, b)), rel=2e-5)


def test_distance_of_sh_pca_channels_is_equation_2(rng):
    model = looks.sh_pca(rng)
    alpha, beta = torch.rand(len(model.views), generator=rng), torch.rand(model.terms, generator=rng)
    found = channels(model, Metric(alpha=alpha, beta=beta))
    for a, b in PAIRS:
        expected = reference.squared_distance(model, alpha, beta, a, b)
        assert between(found, a, b) == pytest.approx(float(expected), rel=2e-5)


@pytest.mark.parametrize("kind", [looks.sh_pca, looks.double_sh])
def test_low_bands_are_those_of_a_smaller_model(kind, rng):
    model = kind(rng)
    terms = torch.zeros(model.terms if kind is looks.sh_pca else model.terms[0])
    terms[:4] = 1
    metric = Metric(beta=torch.ones(len(terms)), bands=2)
    masked = Metric(beta=terms)
    low, cut = channels(model, metric), channels(model, masked)
    for a, b in PAIRS:
        assert between(low, a, b) == pytest.approx(float(between(cut, a, b)), rel=1e-4)


def test_a_picture_is_its_own_channels(rng):
    picture = torch.rand(3, 4, 5, generator=rng)
    assert channels(picture).equal(picture)


def test_codes_keep_the_distance_of_the_channels(rng):
    model = looks.sh_pca(rng, size=(9, 8))
    found, ex = channels(model), exemplar(model, channels_kept=64, energy=1)
    assert ex.kept > 0.999999 and ex.codes.amin() == 0 and ex.codes.amax() == 4095
    for a, b in [((0, 0), (8, 7)), ((1, 2), (2, 2))]:
        assert ex.step**2 * between(ex.codes, a, b) == pytest.approx(float(between(found, a, b)), rel=2e-3)
    power = ex.step**2 * ex.power[3, 3]
    assert float(power) == pytest.approx(float(found[3, 3].square().sum()), rel=1e-4)


def test_few_channels_keep_the_energy_they_say(rng):
    picture = torch.cat([looks.noise(16, 16, rng), 0.05 * torch.rand(16, 16, 4, generator=rng)], -1)
    ex = exemplar(picture, energy=0.9)
    flat = picture.flatten(0, 1).double()
    values = torch.linalg.svdvals(flat - flat.mean(0)).square()
    n = ex.codes.shape[2]
    assert ex.kept == pytest.approx(float(values[:n].sum() / values.sum()), rel=1e-6)
    assert ex.kept >= 0.9 and float(values[: n - 1].sum() / values.sum()) < 0.9


@pytest.mark.parametrize("toroidal", [False, True])
@pytest.mark.parametrize("size", [(9, 11), (12, 8)])
def test_errors_of_all_placements_are_the_exact_whole_numbers(size, toroidal, rng):
    ex = exemplar(looks.noise(*size, rng))
    target = torch.randint(0, 4096, (5, 4, ex.codes.shape[2]), generator=rng)
    mask = torch.rand(5, 4, generator=rng) < 0.6
    found = Search(ex, toroidal=toroidal).errors(target, mask)
    assert found.equal(reference.errors(ex.codes, target, mask, toroidal=toroidal))


def test_errors_stay_exact_for_the_largest_codes_on_a_large_exemplar(rng):
    codes = torch.randint(0, 2, (512, 512, 24), generator=rng) * 4095
    ex = patch_error.Exemplar(codes=codes, power=codes.square().sum(-1), step=1.0, kept=1.0)
    target, mask = codes[100:164, 200:264].clone(), torch.ones(64, 64, dtype=torch.bool)
    target[0, 0, 0] = 4095 - target[0, 0, 0]
    found = Search(ex).errors(target, mask)
    assert int(found[100, 200]) == 4095**2
    for y, x in [(0, 0), (448, 448), (99, 200)]:
        patch = codes[y : y + 64, x : x + 64]
        assert int(found[y, x]) == int((patch - target).square().sum())


def test_bits_do_not_depend_on_the_number_of_threads(rng):
    model, before = looks.eigen(rng, size=(16, 16), rank=6), torch.get_num_threads()
    found = []
    for n in (1, 2):
        torch.set_num_threads(n)
        found.append(exemplar(model))
    torch.set_num_threads(before)
    assert found[0].codes.equal(found[1].codes) and found[0].power.equal(found[1].power)


def test_one_colour_has_errors_of_zero():
    ex = exemplar(torch.full((6, 6, 3), 0.25))
    assert ex.kept == 1 and not Search(ex).errors(ex.codes[:3, :3], torch.ones(3, 3, dtype=torch.bool)).any()


@pytest.mark.errors
def test_bad_input_is_named(rng):
    picture = torch.rand(4, 4, 3, generator=rng)
    picture[1, 2, 0] = torch.nan
    with pytest.raises(ShapeError, match=r"exemplar: expected finite values, got nan"):
        exemplar(picture)
    with pytest.raises(ShapeError, match="exemplar: expected at least one texel"):
        exemplar(torch.zeros(0, 4, 3))
    with pytest.raises(ShapeError, match="expected at most 4 x 4 texels, the exemplar's, got 5 x 3"):
        Search(exemplar(torch.rand(4, 4, 3))).errors(torch.zeros(3, 5, 3).long(), torch.ones(3, 5).bool())
    with pytest.raises(ConfigError, match="a picture has neither views nor harmonics"):
        channels(torch.rand(4, 4, 3), Metric(bands=2))
    with pytest.raises(ConfigError, match="an eigen BTF has no harmonics"):
        channels(looks.eigen(rng), Metric(beta=torch.ones(9)))
    with pytest.raises(ShapeError, match=r"metric.alpha"):
        channels(looks.eigen(rng), Metric(alpha=torch.ones(3)))
    with pytest.raises(ConfigError, match=r"metric.bands"):
        Metric(bands=0)

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.render.scenes import camera
from torchmeso.algebra import spherical_harmonics
from torchmeso.data.distant_light import DistantLight
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.data.sh_btf import ShBtf
from torchmeso.data.sh_pca_btf import ShPcaBtf
from torchmeso.data.textured import Textured
from torchmeso.errors import BackendError, ConfigError
from torchmeso.geometry import frames, hemisphere, shapes
from torchmeso.geometry.directions import normalize
from torchmeso.render import device_environment, environment
from torchmeso.render import frame as frames_of_torch
from torchmeso.render.device_tables import Pool
from torchmeso.render.renderer import Renderer
from torchmeso.render.scene import Material, Object, Points, Scene, in_double

LIGHTS, VIEWS = hemisphere.grid(8, 4, 80), hemisphere.grid(6, 3, 75)


def uniform(rng, *shape):
    return torch.rand(*shape, dtype=torch.float64, generator=rng)


def double_sh(rng):
    maps = uniform(rng, 9, 9, 4, 5, 3) - 0.3
    return ShBtf(maps=maps, scale=torch.ones(9, 9, 3).double(), offset=torch.zeros(9, 9, 3).double(),
                 lights=LIGHTS, views=VIEWS)  # fmt: skip


def sh_pca(rng, domain="hemisphere_fit"):
    return ShPcaBtf(maps=uniform(rng, len(VIEWS), 4, 5, 6), scale=torch.ones(6).double(), offset=uniform(rng, 6),
                    basis=uniform(rng, 6, 9, 3) - 0.3, lights=LIGHTS, views=VIEWS, domain=domain)  # fmt: skip


def eigen(rng):
    return EigenBtf(maps=uniform(rng, len(LIGHTS), 4, 5, 3, 3), weights=uniform(rng, len(VIEWS), 3),
                    scale=torch.ones(3, 3).double(), offset=uniform(rng, 3, 3), lights=LIGHTS, views=VIEWS)  # fmt: skip


KINDS = {
    "double_sh": double_sh, "sh_pca": sh_pca, "projected": lambda rng: sh_pca(rng, "sphere_projection"),
    "eigen": eigen, "plain": lambda rng: None, "textured": lambda rng: Textured(albedo=uniform(rng, 3, 2, 3)),
}  # fmt: skip


def points(n, rng):
    """Points with frames of all directions, every other one mirrored."""
    normal, tangent = (normalize(torch.randn(n, 3, dtype=torch.float64, generator=rng)) for _ in range(2))
    sign = torch.where(torch.arange(n) % 2 == 0, 1.0, -1.0).double()
    one = torch.ones(n, dtype=torch.float64)
    uv, owner = uniform(rng, n, 2), torch.zeros(n, dtype=torch.long)
    return Points(torch.zeros(n, 3).double(), uv, frames.orthonormal(normal, tangent, sign), one, owner, 1e-3 * one)


def upper(n, rng):
    w = normalize(torch.randn(n, 3, dtype=torch.float64, generator=rng))
    return normalize(torch.stack([w[:, 0], w[:, 1], w[:, 2].abs() + 0.2], -1))


def whole_hemisphere(steps=120, around=240):
    """Midpoints of many cells: two parts of the polar angle, which meet at the last ring."""
    nodes, shares = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(6))
    edges = torch.linspace(0, math.pi / 2, 9 * 2 + 1, dtype=torch.float64)
    low, high = edges[:-1, None], edges[1:, None]
    theta = (low + (nodes + 1) / 2 * (high - low)).flatten()
    weight = (shares / 2 * (high - low)).flatten() * theta.sin() * 2 * math.pi / around
    phi = (torch.arange(around, dtype=torch.float64) + 0.5) * 2 * math.pi / around
    w = torch.stack(
        [theta.sin()[:, None] * phi.cos(), theta.sin()[:, None] * phi.sin(), theta.cos()[:, None].expand(-1, around)],
        -1,
    )
    return w.reshape(-1, 3), weight[:, None].expand(-1, around).flatten()


def integrated(material, p, wo, e):
    """(1/pi) times the integral of T L over the hemisphere of each point, by brute force."""
    wi, weight = whole_hemisphere()
    degree = spherical_harmonics.degree_of(len(e))
    total = []
    for k in range(len(wo)):
        frame = frames.Frame(*(x[k] for x in p.frame))
        L = spherical_harmonics.basis(frames.to_world(frame, wi), degree) @ e
        uv, view = p.uv[k].expand(len(wi), 2), wo[k].expand(len(wi), 3)
        if material.btf is None:
            T = torch.tensor(material.albedo).double() * wi[:, 2:]
        else:
            T = material.btf.evaluate(uv, wi, view)
        total.append(weight @ (T * L) / math.pi)
    return torch.stack(total)


@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("degree", [0, 2, 5])
def test_radiance_is_the_integral_of_btf_and_light(kind, degree, rng):
    material = Material(btf=KINDS[kind](rng), albedo=(0.9, 0.5, 0.2))
    p, wo = points(4, rng), upper(4, rng)
    e = uniform(rng, spherical_harmonics.size(degree), 3) - 0.4
    e[0] += 5  # light is nowhere negative
    found = environment.shade(
        Scene(objects=(object_of(material),), lights=()), p, wo, e.expand(4, -1, -1), samples=None
    )
    wanted = integrated(material, p, wo, e)
    assert bool((wanted > 0).any())
    kept = wanted > 0
    torch.testing.assert_close(found[kept], wanted[kept], rtol=1e-4, atol=1e-4)  # measured 4e-6: brute force's own


def object_of(material):
    return Object(mesh=shapes.plane(), material=material)


@pytest.mark.parametrize("degree", range(11))
def test_light_from_everywhere_is_the_ambient_term(degree, rng):
    e = torch.zeros(spherical_harmonics.size(degree), 3, dtype=torch.float64)
    e[0] = math.sqrt(4 * math.pi)  # radiance 1
    p, wo = points(3, rng), upper(3, rng)
    for make in (double_sh, sh_pca, eigen):
        btf = make(rng)
        found = environment.shade(
            Scene(objects=(object_of(Material(btf=btf)),), lights=()), p, wo, e.expand(3, -1, -1), samples=None
        )
        torch.testing.assert_close(found, btf.ambient(p.uv, wo).clamp(min=0), rtol=1e-5, atol=1e-5)


def test_a_lobe_of_light_turns_into_the_frame(rng):
    e = uniform(rng, 25, 3)
    p = points(6, rng)
    local = environment.in_frames(e.expand(6, -1, -1), p.frame)
    w = upper(6, rng)
    world = frames.to_world(p.frame, w)
    here = torch.einsum("nj,njc->nc", spherical_harmonics.basis(w, 4), local)
    torch.testing.assert_close(here, spherical_harmonics.basis(world, 4) @ e, rtol=1e-10, atol=1e-10)


def some_light(rng, degree, vertices=None):
    """Coefficients of a light that is nowhere negative, and some of it at vertices."""
    e = uniform(rng, spherical_harmonics.size(degree), 3) - 0.4
    e[0] += 5
    at = None if vertices is None else e * (0.3 + uniform(rng, vertices, len(e), 1))
    return DistantLight(coefficients=e, at_vertices=at)


def on_device(btf):
    """A BTF in the precision that kernels read."""
    named = {f: getattr(btf, f) for f in btf.__dataclass_fields__}
    parts = {f: x.float() for f, x in named.items() if isinstance(x, torch.Tensor)}
    return replace(btf, **parts)


@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("degree, followed", [(0, False), (3, True), (7, False)])
def test_the_frame_on_opencl_is_that_of_torch(kind, degree, followed, rng, device):
    btf = KINDS[kind](rng)
    material = Material(btf=None if btf is None else on_device(btf), albedo=(0.9, 0.5, 0.2))
    body = shapes.sphere(triangles=200)
    light = some_light(rng, degree, len(body.vertices) if followed else None)
    scene = Scene(objects=(Object(mesh=body, material=material),), lights=(), ambient=0.0, distant=light)
    view = camera((0.7, 1.1, 2.6))
    exact = frames_of_torch.render(in_double(scene), view)
    fast = Renderer(scene).render(view)
    same = (exact.owner == 0) & (fast.owner == 0)
    assert int(same.sum()) > 500
    error = (exact.rgb - fast.rgb.double())[same].abs().amax(-1)
    assert float(error.quantile(0.99)) < 2e-5 * float(exact.rgb.max())  # measured 2e-6; pixels of seams differ


def test_another_light_replaces_the_one_before(rng, device):
    body = shapes.sphere(triangles=200)
    made = Scene(objects=(Object(mesh=body, material=Material(btf=on_device(eigen(rng)))),), lights=(), ambient=0.0)
    view = camera((0.7, 1.1, 2.6))
    renderer = Renderer(made)
    assert float(renderer.render(view).rgb.max()) == 0
    for light in (some_light(rng, 2), some_light(rng, 4, len(body.vertices)), None):
        scene = replace(made, distant=light)
        renderer.update(scene)
        torch.testing.assert_close(renderer.render(view).rgb.clone(), Renderer(scene).render(view).rgb)


@pytest.mark.errors
def test_what_has_no_harmonics_is_refused(rng):
    class Other:
        def evaluate(self, *_):
            raise NotImplementedError

        ambient = evaluate

    light = DistantLight(coefficients=torch.ones(1, 3))
    with pytest.raises(ConfigError, match="a Other cannot be lit in the frequency domain"):
        environment.check(Scene(objects=(object_of(Material(btf=Other())),), lights=(), distant=light))


@pytest.mark.errors
def test_what_kernels_have_no_room_for_is_refused(rng, device):
    body, wide = shapes.sphere(triangles=200), on_device(eigen(rng))
    clay = Scene(objects=(Object(mesh=body, material=Material()),), lights=(), distant=some_light(rng, 8))
    with pytest.raises(BackendError, match="distant light up to degree 7, got 8; use the torch backend"):
        Renderer(clay).render(camera((0.7, 1.1, 2.6)))
    rank = 65
    wide = replace(wide, maps=torch.rand(*wide.maps.shape[:3], rank, 3, generator=rng), offset=torch.zeros(rank, 3),
                   scale=torch.ones(rank, 3), weights=torch.rand(len(VIEWS), rank, generator=rng))  # fmt: skip
    with pytest.raises(BackendError, match="at most 64 components, got 65; use the torch backend"):
        device_environment._over_light(Pool(), wide)

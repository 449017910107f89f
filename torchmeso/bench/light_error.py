"""Rows of the suite `light` on error: sampled environments, harmonics of a light, transfer.

Sampling is held against 10,000 lights of the same map on points of a knot with a coat and diffuse matter below it, with
the knot's own shadows by rays. For errors every rotation of a map is sampled anew; for flicker its lights turn with it.

Test: tests/bench/test_light.py
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra import spherical_harmonics
from torchmeso.bench.suite import Context, Row
from torchmeso.config import data_dir
from torchmeso.data import environment, sky
from torchmeso.data.environment import Environment, Texels
from torchmeso.geometry import frames, shapes
from torchmeso.geometry.directions import normalize
from torchmeso.geometry.light import DirectionalLight
from torchmeso.geometry.rays import RayScene, offset
from torchmeso.pipeline.environment import about
from torchmeso.transport import light_sampling, materials, transfer
from torchmeso.transport.light_sampling import Method
from torchmeso.transport.materials import Reflectance
from torchmeso.transport.transfer import Bodies, TransferOptions

MAPS = ("grace", "uffizi")
COUNTS = (50, 100, 200)
METHODS: tuple[Method, ...] = ("quadtree", "median_cut", "uniform")
REFERENCE = 10_000


class Points(NamedTuple):
    """What is lit: where on the knot, in which frames, seen from where, of what matter, with what around it."""

    origin: Tensor
    frame: frames.Frame
    wo: Tensor
    material: Reflectance
    around: RayScene


def points_of_a_knot(count: int = 256) -> Points:
    """Return evenly chosen vertices of the 12k knot that face a viewer."""
    knot = shapes.torus_knot(triangles=11952)
    towards = torch.tensor([0.3, -1.6, 4.2]).expand_as(knot.vertices)
    normals = normalize(knot.normals)
    seen = (normalize(towards - knot.vertices) * normals).sum(-1) > 0.1
    which = seen.nonzero()[:, 0]
    which = which[torch.linspace(0, len(which) - 1, count).long()]
    frame = frames.around(normals[which])
    wo = frames.to_local(frame, normalize(towards[which] - knot.vertices[which]))
    one = torch.ones(count, 1, 1)
    material = Reflectance(0.5 * one.expand(-1, 1, 3), 0.3 * one[..., 0], 0.04 * one.expand(-1, 1, 3))
    return Points(
        offset(knot.vertices[which], normals[which], 10.0), frame, wo, material, RayScene(knot.vertices, knot.faces)
    )


def radiance(points: Points, w: Float[Tensor, "light 3"], E: Float[Tensor, "light 3"]) -> Float[Tensor, "n 3"]:
    """Return the radiance of the points under directional lights, float64."""
    total = torch.zeros(len(points.origin), 3, dtype=torch.float64)
    for part, power in zip(w.float().split(512), E.split(512), strict=True):
        n, lights = len(points.origin), len(part)
        frame = frames.Frame(*(x[:, None].expand(-1, lights, 3) for x in points.frame))
        wi = frames.to_local(frame, part.expand(n, -1, -1))
        f = materials.evaluate(points.material, wi, points.wo[:, None]) * wi[..., 2:].clamp(min=0)
        lit = wi[..., 2] > 0
        which = lit.nonzero()
        dark = points.around.occluded(points.origin[which[:, 0]], part[which[:, 1]])
        lit[which[dark, 0], which[dark, 1]] = False
        total += torch.einsum("nlc,lc->nc", (f * lit[..., None]).double(), power.double())
    return total


def sampling(context: Context) -> Iterator[Row]:
    """Error of few lights."""
    points, rotations = points_of_a_knot(), 8 if context.quick else 64
    for name, made in _maps():
        if made is None:
            yield _absent(f"light.sampling.{name}", "error of sampled lights", "relative")
            continue
        errors: dict[tuple[Method, int], list[float]] = {}
        signed: dict[tuple[Method, int], list[float]] = {}
        for k, texels in enumerate(_turned(made.texels(), rotations)):
            context.report(f"lights of {name}", k / rotations)
            wanted = radiance(points, *light_sampling.directions(texels, REFERENCE))
            for method in METHODS:
                for count in COUNTS:
                    found = radiance(points, *light_sampling.directions(texels, count, method=method))
                    rms = float((found - wanted).square().mean().sqrt() / wanted.mean())
                    errors.setdefault((method, count), []).append(rms)
                    signed.setdefault((method, count), []).append(float((found - wanted).mean() / wanted.mean()))
        yield from _sampling_rows(name, errors, signed)


def _sampling_rows(name: str, errors: dict, signed: dict) -> Iterator[Row]:
    means = {key: sum(x) / len(x) for key, x in errors.items()}
    for (method, count), mean in means.items():
        others = min(means[other, count] for other in METHODS[1:])
        ours = method == "quadtree"
        n = len(errors[method, count])
        yield Row(
            id=f"light.sampling.{name}.{count}.{method}",
            what=f"{count} lights of {name.upper()} by {method} against {REFERENCE}, mean over {n} rotations: "
            "RMS error over mean radiance",
            value=round(mean, 4), unit="relative", better="lower", goal=round(others, 4) if ours else None,
            n=n, peer=f"the better of median cut and uniform {others:.4f}" if ours else None,
            spread=(round(min(errors[method, count]), 4), round(max(errors[method, count]), 4)),
            curve={"series": f"{name} {method}", "x": count, "x_label": "lights"},
        )  # fmt: skip
    for count in COUNTS:
        off = torch.tensor(signed["quadtree", count], dtype=torch.float64)
        yield Row(
            id=f"light.bias.{name}.{count}",
            what=f"mean error of {count} lights of {name.upper()} over {len(off)} rotations, in standard errors",
            value=round(float(off.mean().abs() / (off.std() / math.sqrt(len(off))).clamp(min=1e-12)), 2), unit="SE",
            better="lower", goal=2.0, n=len(off), peer=f"mean {float(off.mean()):+.4f}",
        )  # fmt: skip


def flicker(context: Context) -> Iterator[Row]:
    """Steps from frame to frame where a map turns."""
    points, count = points_of_a_knot(), 20 if context.quick else 60
    for name, made in _maps():
        if made is None:
            yield _absent(f"light.flicker.{name}", "flicker of sampled lights", "x")
            continue
        pictures: dict[str, list[Tensor]] = {}
        for k in range(count):
            context.report(f"{name} turns", k / count)
            turned = replace(made, rotation=about((0.0, 1.0, 0.0), float(k)) @ made.rotation.double())
            anew = turned.texels()
            seen = {"reference": light_sampling.directions(anew, REFERENCE)}
            for method in METHODS[:2]:
                seen[method] = _together(light_sampling.lights(turned, 200, method=method))
                seen[f"{method} anew"] = light_sampling.directions(anew, 200, method=method)
            for key, lights in seen.items():
                pictures.setdefault(key, []).append(radiance(points, *lights))
        step = {k: float(torch.stack(x).diff(dim=0).square().mean().sqrt()) for k, x in pictures.items()}
        ratio = {k: round(x / step["reference"], 3) for k, x in step.items()}
        for row, how in (("", "its lights turned with it"), (" anew", "sampled anew each time")):
            yield Row(
                id=f"light.flicker.{name}{row.replace(' ', '.')}",
                what=f"{name.upper()} turned {count} times by a degree, 200 lights, {how}: RMS between frames over the "
                "reference's",
                value=ratio[f"quadtree{row}"], unit="x", better="lower", n=count,
                goal=None if row else min(1.5, ratio["median_cut anew"]),
                peer=f"median cut {ratio['median_cut anew']} sampled anew, {ratio['median_cut']} turned",
            )  # fmt: skip


def _together(lights: tuple[DirectionalLight, ...]) -> tuple[Tensor, Tensor]:
    return torch.stack([x.direction for x in lights]).double(), torch.stack([x.irradiance for x in lights]).double()


def energy(context: Context) -> Iterator[Row]:
    """What lights carry of a map."""
    worst = 0.0
    maps = [sky.build(), *(made for _, made in _maps() if made is not None)]
    for made in maps:
        for method in METHODS:
            for count in (1, 12, 50, 200, 5000):
                E = sum(light.irradiance.double() for light in light_sampling.lights(made, count, method=method))
                worst = max(worst, float(((E - made.irradiance()) / made.irradiance()).abs().max()))
    yield Row(
        id="light.energy", what=f"largest error of the sum of all lights, {len(maps)} maps, 1 to 5000 lights",
        value=float(f"{worst:.2g}"), unit="relative", better="lower", goal=1e-6,
    )  # fmt: skip


def bands(context: Context) -> Iterator[Row]:
    """Error of harmonics of a light over their degree: diffuse matter and the coat, without shadows."""
    knot = points_of_a_knot()
    for name, made in _maps():
        if made is None:
            continue
        w, solid_angle, L = made.texels()
        wanted = _unshadowed(knot, w, solid_angle[:, None] * L)
        for degree in (0, 1, 2, 3, 5, 7, 10):
            c = made.harmonics(degree)
            shine = torch.cat([spherical_harmonics.basis(part, degree) @ c for part in w.split(1 << 15)])
            found = _unshadowed(knot, w, solid_angle[:, None] * shine)
            yield Row(
                id=f"light.bands.{name}.{degree}",
                what=f"harmonics of {name.upper()} to degree {degree}: RMS error of coated points over mean radiance",
                value=round(float((found - wanted).square().mean().sqrt() / wanted.mean()), 4), unit="relative",
                better="lower", curve={"series": name, "x": degree, "x_label": "degree"},
            )  # fmt: skip


def _unshadowed(points: Points, w: Tensor, E: Tensor) -> Tensor:
    wo = points.wo[::8, None]
    frame, material = frames.Frame(*(x[::8] for x in points.frame)), Reflectance(*(x[::8] for x in points.material))
    total = torch.zeros(len(wo), 3, dtype=torch.float64)
    for part, power in zip(w.float().split(4096), E.split(4096), strict=True):
        wide = frames.Frame(*(x[:, None].expand(-1, len(part), 3) for x in frame))
        wi = frames.to_local(wide, part.expand(len(total), -1, -1))
        f = materials.evaluate(material, wi, wo) * wi[..., 2:].clamp(min=0)
        total += torch.einsum("nlc,lc->nc", f.double(), power.double())
    return total


def through_transfer(context: Context) -> Iterator[Row]:
    """Transfer against closed forms, at its default rays."""
    options = TransferOptions(bounces=0)
    worst = 0.0
    for angle_deg in (10, 25, 40, 55, 70):
        angle = math.radians(angle_deg)
        M = transfer.bake(under_a_disc(angle), options).matrices[0, 0].double()
        wanted = _of_a_cap(angle, options.degree)
        worst = max(worst, float((M[:, 0] - wanted).abs().max()))
    yield Row(
        id="light.transfer.occluder",
        what=f"transfer of white light past one round plate, half angle 10 to 70 degrees, {options.rays} rays: largest "
        "error of a harmonic against the cap's integral",
        value=float(f"{worst:.2g}"), unit="relative", better="lower", goal=1e-3,
    )  # fmt: skip
    torus = shapes.torus(tube=0.45, triangles=1200)
    white = Bodies(torus.vertices, torus.faces, normalize(torus.normals), torch.ones_like(torus.vertices))
    found = transfer.bake(white, TransferOptions(degree=4, bounces=24)).matrices[:, 0]
    e = torch.zeros(25)
    e[0] = 1
    yield Row(
        id="light.transfer.furnace",
        what="a white torus in white light, 24 bounces: largest error of a harmonic at any vertex",
        value=float(f"{float((found @ e - e).abs().max()):.2g}"), unit="relative", better="lower", goal=1e-3,
    )  # fmt: skip


def under_a_disc(angle: float) -> Bodies:
    """Return a point below a round plate that it sees under the half angle `angle`."""
    phi = torch.arange(720) * (2 * math.pi / 720)
    rim = torch.stack([math.tan(angle) * phi.cos(), math.tan(angle) * phi.sin(), torch.ones_like(phi)], -1)
    k = torch.arange(720)
    vertices = torch.cat([torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]), rim])
    faces = torch.stack([torch.ones_like(k), k + 2, (k + 1) % 720 + 2], -1)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(len(vertices), 3)
    return Bodies(vertices, faces, up, torch.zeros(len(vertices), 3))


def _of_a_cap(angle: float, degree: int) -> Tensor:
    """Return what is left of white light: the integral of y_i y_0 outside of the cap; of P_l in closed form."""
    z = torch.tensor([[math.sin(angle), 0.0, math.cos(angle)], [0.0, 0.0, 1.0]], dtype=torch.float64)
    y = spherical_harmonics.basis(z, degree + 1)
    left = torch.zeros(spherical_harmonics.size(degree), dtype=torch.float64)
    for l in range(degree + 1):
        P = [float(y[0, k * k + k]) / math.sqrt((2 * k + 1) / (4 * math.pi)) for k in range(l + 2)]
        # The integral of P_l from z to 1 is (P_(l-1)(z) - P_(l+1)(z)) / (2 l + 1), and 1 - z for l = 0.
        part = 1 - math.cos(angle) if l == 0 else (P[l - 1] - P[l + 1]) / (2 * l + 1)
        left[l * l + l] = (1.0 if l == 0 else 0.0) - 2 * math.pi * math.sqrt(2 * l + 1) / (4 * math.pi) * part
    return left


def _maps() -> Iterator[tuple[str, Environment | None]]:
    for name in MAPS:
        path = data_dir() / "hdr" / f"{name}.hdr"
        yield name, environment.read(path) if path.is_file() else None


def _turned(texels: Texels, count: int) -> Iterator[Texels]:
    """Yield a map in random rotations, the same in every run."""
    rng = torch.Generator().manual_seed(0)
    for _ in range(count):
        R = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=rng)).Q
        yield Texels(texels.directions @ (R * torch.linalg.det(R)).mT, *texels[1:])


def _absent(row_id: str, what: str, unit: str) -> Row:
    return Row(
        id=row_id, what=what, value=None, unit=unit, better="lower",
        why="the folder of real inputs is absent: set TORCHMESO_DATA",
    )  # fmt: skip

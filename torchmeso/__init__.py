"""Meso-scale appearance on a CPU: bake, compress and render BTFs with mesostructure silhouettes and shadows.

Conventions, used without repetition everywhere:

Directions
    `wi` to the light, `wo` to the viewer, unit, away from the surface. Local frame (t, b, n): t along +u, b along
    +v, z = n. Where texture coordinates are mirrored the frame is left-handed (`sign` = -1), so local directions
    are dot products. Suffix-free = local, `_world` otherwise. Radians in code; degrees (`_deg`) at the command line,
    in configurations and files. theta from +z, phi from +x to +y.
Texture space
    u right, v up, texel centres at (i + 0.5) / N, tiles repeat with period 1, u and v unbounded. Arrays store row 0
    at the top (v near 1); `data.address` converts.
Slab
    z in [-h, 0] tile units (1 = the side of a texture tile); 0 = top = reference plane, above all material. u, v and
    z share one unit. Texture scale s = sqrt(world area / UV area) turns tile units into world lengths.
MDF D(u, v, wo)
    Distance along -wo from the reference plane to the first solid point, kept as the drop
    delta = D cos(theta_o) / h in [0, 1]; "no hit" is one explicit bit, and D = +inf there passes every test. Below the
    last ring delta keeps the ring's value and D = delta h / max(cos(theta_o), cos 89.5 deg).
BTF value
    T = pi f_r cos(theta_i), linear RGB, unclamped: a white diffuser lit at normal incidence has T = 1. Beyond the last
    ring T falls off with cos(theta_i) / cos(last) along the light and is held along the view; T = 0 for wi below the
    horizon.
Light
    Radiance = (1/pi) sum over visible lights of E T + ambient L_a, with L_a = (1/pi) times the integral of T over the
    light hemisphere. A directional light's E is its irradiance at normal incidence (default pi), a point or spot
    light's intensity / r^2.
Camera
    Right-handed world, looks along -z, vertical `fov_deg`, pixel centres at (i + 0.5), row 0 on top. Depth t is the
    distance along the pixel's ray, float32; ties are ordered by triangle.
Intervals
    A ray is inside a closed component from an opening to a closing face (winding 0 -> 1 -> 0); it hits the
    mesostructure when d_f + d_b <= |p_f - p_b|, with d = s D at the two ends (wang2005mdf, section 4.1; `paper`), or
    when it dips below the relief on its way under the curved surface (`curved`). Open surfaces are single layers.
Shadows
    A closed surface casts its shadow from where the light leaves it, an open one from the base of its slab. A receiver
    is p - s D wo_world: the point that is seen, not the one on the base surface.
Axes
    `light view H W C` for a BTF, `view H W` for an MDF; einsum letters l v h w k c. Random state is a
    `torch.Generator` argument; the same seed gives the same bits at any thread count. float32 to compute, float64 to
    accumulate and as reference, uint8 or float16 to store.
"""

from importlib import import_module
from types import ModuleType

__version__ = "0.1.0"

_STAGES = ("meso", "compress", "render", "pipeline", "data", "geometry", "transport", "quality")


def __getattr__(name: str) -> ModuleType:
    """Import a stage when it is first used: `import torchmeso` itself stays cheap."""
    if name in _STAGES:
        return import_module(f"torchmeso.{name}")
    raise AttributeError(f"module 'torchmeso' has no attribute '{name}'")

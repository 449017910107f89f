"""How far a BTF model is from the table it was made from: for every light and view, and drawn over both hemispheres.

Models are asked at texel centres of the table, on a lattice of rows and columns where the table is large, in the
directions of the table, so that models on other directions can be compared too. Errors are PSNR on the screen, all
at the exposure of the whole table (`quality`).

Test: tests/pipeline/test_directional_error.py
"""

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso import quality
from torchmeso.data.address import texel_centres
from torchmeso.data.btf import Bands, Evaluable
from torchmeso.data.store import replacing
from torchmeso.errors import BackendError, ConfigError
from torchmeso.geometry import gaps
from torchmeso.geometry.hemisphere import DirectionSet
from torchmeso.pipeline import picture_sets
from torchmeso.pipeline.bake import Report, open_model, silent

VALUES = 1 << 24
"""Values of T that are compared at most: 64 MiB of the table and as much of the model."""

WORST_PSNR = 120.0
"""In dB, of pictures that are equal to the last bits: what infinity is drawn and averaged as."""

TABLES = (".btf.zarr", ".btf", ".zip")


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class DirectionalError:
    """PSNR of a model by direction.

    Attributes:
        psnr: (light, view) in dB, at most 120.
        lights: of the table.
        views: of the table.
        texels: texels compared, and texels of the table.
        max_error: largest difference of T.
    """

    psnr: Float[Tensor, "light view"]
    lights: DirectionSet
    views: DirectionSet
    texels: tuple[int, int]
    max_error: float

    @property
    def over_lights(self) -> Float[Tensor, "light"]:
        """PSNR of each light, of the mean squared error over all views."""
        return _mean_psnr(self.psnr, 1)

    @property
    def over_views(self) -> Float[Tensor, "view"]:
        """PSNR of each view, of the mean squared error over all lights."""
        return _mean_psnr(self.psnr, 0)

    @property
    def whole(self) -> float:
        """PSNR of all pictures together."""
        return float(_mean_psnr(self.psnr.flatten(), 0))


def is_btf(path: str | Path) -> bool:
    """Return whether `path` is a BTF: a table, pictures, or a run-time model."""
    return str(path).rstrip("/").lower().endswith((*TABLES, ".meso")) or picture_sets.is_one(path)


def compare(source: str | Path, model: str | Path, report: Report = silent) -> DirectionalError:
    """Return how far the BTF `model` is from `source`.

    Args:
        source: a table (.btf.zarr or .btf), or a folder or zip of pictures.
        model: a run-time model (.meso), or a table of the same size.
        report: called with a name and the share done, 0..1.

    Raises:
        ConfigError: `source` is a model, or the two tables differ in size or directions.
        FormatError: a file is missing or damaged.
    """
    if str(source).endswith(".meso"):
        raise ConfigError(f"{source}: expected a BTF table as the reference, got a model; name the table first")
    table = picture_sets.open_btf(source, report)
    if str(model).endswith(".meso"):
        found: Bands | Evaluable = open_model(model, depth=False).btf  # pyright: ignore[reportAssignmentType]
    else:
        found = picture_sets.open_btf(model, report)
    return measure(table, found, report)


def measure(table: Bands, model: Bands | Evaluable, report: Report = silent) -> DirectionalError:
    """Return how far `model` is from `table`: by its values where it is a table, else by `evaluate`.

    Raises:
        ConfigError: two tables differ in size or directions.
    """
    rows, columns = _lattice(table)
    reference = _taken(table, rows, columns)
    if isinstance(model, Bands):
        if (model.texels, len(model.lights), len(model.views)) != (table.texels, len(table.lights), len(table.views)):
            raise ConfigError(
                f"compare: expected tables of one size, got {_told(table)} and {_told(model)}; compare a model (.meso)"
            )
        shown = _taken(model, rows, columns)
    else:
        shown = _evaluated(table, model, rows, columns, report)
    return DirectionalError(
        psnr=quality.psnr_by_picture(reference, shown).clamp(max=WORST_PSNR),
        lights=table.lights,
        views=table.views,
        texels=(len(rows) * len(columns), math.prod(table.texels)),
        max_error=float((reference - shown).abs().max()),
    )


def _lattice(table: Bands) -> tuple[list[int], list[int]]:
    """Return the rows and columns that are compared: all, or every n-th."""
    pictures = len(table.lights) * len(table.views)
    step = math.ceil(math.sqrt(math.prod(table.texels) * pictures * 3 / VALUES))
    height, width = table.texels
    return list(range(step // 2, height, step)) or [0], list(range(step // 2, width, step)) or [0]


def _taken(table: Bands, rows: list[int], columns: list[int]) -> Float[Tensor, "light view rows columns 3"]:
    return torch.cat([table.rows(row, row + 1)[:, :, :, columns] for row in rows], 2)


def _evaluated(
    table: Bands, model: Evaluable, rows: list[int], columns: list[int], report: Report
) -> Float[Tensor, "light view rows columns 3"]:
    uv = texel_centres(*table.texels)[rows][:, columns].reshape(-1, 2)
    lights, views = table.lights.directions(), table.views.directions()
    shown = torch.empty(len(lights), len(views), len(rows), len(columns), 3)
    for v, wo in enumerate(views):
        for l, wi in enumerate(lights):
            found = model.evaluate(uv, wi.expand(len(uv), 3), wo.expand(len(uv), 3))
            shown[l, v] = found.unflatten(0, (len(rows), len(columns)))
        report("model", (v + 1) / len(views))
    return shown


def _mean_psnr(psnr: Tensor, dim: int) -> Tensor:
    return -10 * (10 ** (-psnr.double() / 10)).mean(dim).log10().float()


def _told(table: Bands) -> str:
    height, width = table.texels
    return f"{len(table.lights)} x {len(table.views)} directions of {width} x {height} texels"


def draw(found: DirectionalError, path: str | Path) -> None:
    """Write two polar plots (.png or .svg): PSNR over the directions to the light, and over those to the viewer.

    Raises:
        BackendError: matplotlib is not installed.
    """
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import cm, colors, pyplot
    except ImportError as error:
        raise BackendError("compare: expected matplotlib; install the extra: torchmeso[report]") from error
    panels = {
        "light wi (mean over views)": (found.lights, found.over_lights),
        "view wo (mean over lights)": (found.views, found.over_views),
    }
    low, high = (float(f(torch.cat([x for _, x in panels.values()]))) for f in (torch.min, torch.max))
    figure, axes = pyplot.subplots(1, 2, figsize=(10, 4.8), subplot_kw={"projection": "polar"})
    shade = cm.ScalarMappable(colors.Normalize(low, max(high, low + 1e-3)), "viridis")
    for axis, (title, (directions, psnr)) in zip(axes, panels.items(), strict=True):
        theta, phi = zip(*gaps.angles_deg(directions), strict=True)
        size = max(20.0, 9000.0 / len(directions))
        around = [math.radians(x) for x in phi]
        axis.scatter(around, theta, c=psnr.numpy(), s=size, cmap=shade.cmap, norm=shade.norm, zorder=3)
        axis.set_rlim(0, 90)
        axis.set_rticks([30, 60, 90])
        axis.grid(alpha=0.4)
        axis.set_title(title, fontsize=10)
    figure.colorbar(shade, ax=list(axes), label="PSNR (dB)", shrink=0.8)
    with replacing(path) as beside:
        figure.savefig(beside, format=Path(path).suffix.lstrip(".").lower() or "png", dpi=110)
    pyplot.close(figure)

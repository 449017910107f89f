"""The demonstration: the built-in scene from its mesostructure to a picture, beside BTF only and the truth.

Test: tests/pipeline/test_demo.py
"""

import time
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import torch
from torch import Tensor

from torchmeso import quality
from torchmeso.config_sections import Config
from torchmeso.data import image
from torchmeso.data.store import replacing
from torchmeso.errors import FormatError
from torchmeso.pipeline import report as reports
from torchmeso.pipeline import truth as truths
from torchmeso.pipeline.bake import Report, silent
from torchmeso.pipeline.render import Painter, render
from torchmeso.pipeline.report import Figure, Page
from torchmeso.pipeline.scene import bare
from torchmeso.render import film
from torchmeso.render.scene import Scene


def built_in(name: str) -> Path:
    """Return the configuration `name` that ships with the package (in a checkout: the folder configs).

    Raises:
        FormatError: there is none of that name.
    """
    for folder in (Path(str(files("torchmeso"))) / "configs", Path(__file__).resolve().parents[2] / "configs"):
        if (folder / f"{name}.yaml").is_file():
            return folder / f"{name}.yaml"
    raise FormatError(f"{name}: expected a built-in configuration, found none; reinstall torchmeso")


def run(config: Config, out: str | Path, report: Report = silent) -> list[Path]:
    """Make the picture, the same view with the BTF only, the truth, the difference and a report in the folder `out`.

    Returns:
        the files written: picture.png, picture.exr, btf_only.png, truth.png, difference.png, report.html.

    Raises:
        MesoError: a file is missing or unreadable, or an option is out of range.
    """
    out = Path(out)
    seconds: dict[str, float] = {}
    start = time.perf_counter()
    made = render(config, report)
    for name, asset in made.assets.items():
        seconds |= {f"{name}: {step}": s for step, s in asset.seconds.items()}
    picture = made.picture
    seconds |= {f"frame: {step}": s for step, s in picture.seconds.items()}
    options = replace(config.render, silhouette="none")
    plain = Painter(bare(made.scene), options, config.backend).paint(config.camera.build())
    before = time.perf_counter()
    truth = truths.render(config, report)
    seconds["truth (0 s when cached)"] = time.perf_counter() - before
    seconds["all"] = time.perf_counter() - start

    films = {"picture": picture.rgb, "BTF only": plain.rgb}
    shown = image.to_linear(quality.difference(truth.rgb, picture.rgb))
    page = Page(
        title=f"torchmeso: {config.name}",
        figures=[
            Figure("Picture", "BTF and MDF: silhouettes and shadows of the mesostructure.", picture.rgb),
            Figure("BTF only", "The same view without the MDF: smooth outlines.", plain.rgb),
            Figure("Truth", "The mesostructure laid over the mesh as triangles, path-traced.", truth.rgb),
            Figure("Difference", "Four times the absolute difference between picture and truth.", shown),
        ],
        comparisons={name: quality.compare(truth.rgb, rgb) for name, rgb in films.items()},
        silhouettes=[
            (name, *_outline(made.scene, owner, truth.owner))
            for name, owner in (("picture", picture.owner), ("BTF only", plain.owner))
        ],
        seconds=seconds,
        assets=made.assets,
        counts=picture.counts,
        machine=reports.machine(),
    )
    names = ["picture.png", "picture.exr", "btf_only.png", "truth.png", "difference.png", "report.html"]
    paths = [out / name for name in names]
    film.write(picture, paths[0])
    film.write(picture, paths[1])
    for path, rgb in zip(paths[2:5], (plain.rgb, truth.rgb, shown), strict=True):
        image.write_png(path, rgb)
    with replacing(paths[5]) as beside:
        beside.write_text(reports.to_html(page), encoding="utf-8")
    return paths


def _outline(scene: Scene, owner: Tensor, truth: Tensor) -> tuple[float, float]:
    """Return IoU and outline distance of the pixels that show an object with a mesostructure."""
    textured = torch.tensor(
        [i for i, o in enumerate(scene.objects) if any(m.mdf is not None for m in o.materials)], dtype=torch.long
    )
    a, b = torch.isin(owner, textured), torch.isin(truth, textured)
    return quality.iou(a, b), quality.boundary_distance(a, b)

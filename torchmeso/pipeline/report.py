"""A one-page HTML report of a picture beside its truth: pictures inline, nothing loaded from a network.

Test: tests/pipeline/test_report.py
"""

import base64
import io
from dataclasses import dataclass
from importlib.resources import files
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data import image
from torchmeso.errors import human_size
from torchmeso.pipeline.bake import Asset
from torchmeso.quality import Comparison


class Figure(NamedTuple):
    """A picture of the report: a few words, one sentence, linear RGB (H, W, 3)."""

    title: str
    caption: str
    linear: Float[Tensor, "H W 3"]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Page:
    """Everything a report shows.

    Attributes:
        title: heading.
        figures: the pictures.
        comparisons: against the truth, by name.
        silhouettes: (name, IoU of the object mask, mean outline distance in pixels) against the truth.
        seconds: wall time by step.
        assets: materials with their sizes.
        counts: what the renderer did and skipped.
        machine: one line on the computer.
    """

    title: str
    figures: list[Figure]
    comparisons: dict[str, Comparison]
    silhouettes: list[tuple[str, float, float]]
    seconds: dict[str, float]
    assets: dict[str, Asset]
    counts: dict[str, int]
    machine: str


def to_html(page: Page) -> str:
    """Return the report as one HTML file."""
    from jinja2 import Environment

    template = files("torchmeso.pipeline").joinpath("report.html.j2").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["inline"] = _inline
    environment.filters["human_size"] = human_size
    return environment.from_string(template).render(page=page)


def machine() -> str:
    """Return one line on the computer: processor, cores, threads, OpenCL device."""
    import os
    import platform

    from torchmeso.backends import opencl

    devices = [d.device for d in opencl.list_devices() if d.chosen]
    return (
        f"{processor()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads, torch {torch.__version__}, "
        f"Python {platform.python_version()}, OpenCL: {devices[0] if devices else 'none'}"
    )


def processor() -> str:
    """Return the name of the processor."""
    import platform

    try:
        with open("/proc/cpuinfo") as about:
            return next(line.split(":")[1].strip() for line in about if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _inline(linear: Tensor) -> str:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image.to_bytes(linear)).save(buffer, format="PNG")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()

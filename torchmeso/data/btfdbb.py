"""BTFs in Bonn's `.btf` files (UBO2014 and older): full matrix factorisations, factorisations per view, plain chunks.

Values become T = pi f_r cos(theta_i), linear RGB, unclamped, at this door. The cosine flag of a file says whether its
values hold the factor cos(theta_i): flag 1, they are T as they stand; flag 0, they are multiplied by cos(theta_i) of
the listed light. Headers too old to have the flag are taken to hold it, because photographs do. Where a file is known
to be flagged wrongly, `cosine` overrides it.

Files keep texel rows from the bottom (v near 0) up and any order of directions; here row 0 is the top and directions
are in the order of their rings. Nothing but the header is read when a file is opened: factors are mapped, and
decoded for a band of texel rows or for one picture, so that a table of 22 GB is never in memory. The file must not
change meanwhile.

Layouts: `data.btfdbb_header`, `data.btfdbb_body` (DFMF, FMF, PVF), `data.btfdbb_bdi`; colours: `data.btfdbb_colour`.

Test: tests/data/test_btfdbb.py
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data import btfdbb_bdi, btfdbb_body, btfdbb_colour, btfdbb_header, store
from torchmeso.data.btf import LARGEST, Btf
from torchmeso.data.btfdbb_body import Body
from torchmeso.data.btfdbb_colour import Colour
from torchmeso.data.btfdbb_header import Cursor, Header
from torchmeso.errors import FormatError, check_finite, check_memory, check_range
from torchmeso.geometry import rings
from torchmeso.geometry.hemisphere import DirectionSet
from torchmeso.geometry.rings import Found

MEMORY_LIMIT = 4 << 30
"""Bytes that are decoded at once."""

BLOCK_BYTES = 128 << 20
"""Decoded bytes of one band of texel rows while a table is read whole."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class File:
    """A file as it is: what its header says, and its numbers on disk.

    Attributes:
        path: of the file.
        header: measurement, directions, size.
        body: numbers of the colour model, decoded a part at a time.
        colour: what the numbers stand for.
    """

    path: str
    header: Header
    body: Body
    colour: Colour

    def directions(self) -> tuple[Found, Found]:
        """Return lights and views as direction sets.

        Raises:
            FormatError: they are no rings of even steps.
        """
        lights, views = (
            rings.recognise(f"{self.path}: {name}", torch.from_numpy(listed.astype(np.float64)))
            for name, listed in (("lights", self.header.lights), ("views", self.header.views))
        )
        return lights, views


@dataclass(frozen=True, eq=False, kw_only=True)
class BonnBtf:
    """A BTF that stays in its file and is decoded a band or a picture at a time.

    Attributes:
        file: where it is.
        lights: directions towards the light.
        views: directions towards the viewer.
        light_order: (light) place in the file of each light of the set.
        view_order: (view) the same for views.
        foreshortening: (light) what values are multiplied by to hold cos(theta_i), in the order of the set.
    """

    file: File
    lights: DirectionSet
    views: DirectionSet
    light_order: Tensor
    view_order: Tensor
    foreshortening: Float[Tensor, "light"]

    @property
    def texels(self) -> tuple[int, int]:
        """Height and width of the texture."""
        return self.file.header.height, self.file.header.width

    def rows(self, start: int, stop: int) -> Float[Tensor, "light view rows W 3"]:
        """Return T of texel rows start .. stop of all pictures as float32; up to four times that in memory.

        Raises:
            FormatError: a chunk is damaged.
            ShapeError: a value is not finite, or beyond `btf.LARGEST`.
            SizeError: the band takes more than `MEMORY_LIMIT`.
        """
        height, width = self.texels
        start, stop, _ = slice(start, stop).indices(height)
        n_light, n_view = len(self.lights), len(self.views)
        if start >= stop:
            return torch.zeros(n_light, n_view, 0, width, 3)
        size = n_light * n_view * (stop - start) * width * 12.0
        check_memory(f"{self.file.path}: rows {start} to {stop}", size, MEMORY_LIMIT, "read fewer rows at a time")
        texels = slice((height - stop) * width, (height - start) * width)
        rgb = self._rgb(slice(0, n_light * n_view), texels).reshape(n_view, n_light, -1, width, 3)
        band = rgb[self.view_order[None, :], self.light_order[:, None]].flip(2)
        return self._checked(band.mul_(self.foreshortening[:, None, None, None, None]))

    def picture(self, light: int, view: int) -> Float[Tensor, "H W 3"]:
        """Return T of one light and view as float32, row 0 on top; of a factored file only its own factors are read.

        Raises:
            ConfigError: there is no such light or view.
            FormatError: a chunk is damaged.
            ShapeError: a value is not finite, or beyond `btf.LARGEST`.
        """
        check_range("picture: light", light, 0, len(self.lights) - 1)
        check_range("picture: view", view, 0, len(self.views) - 1)
        height, width = self.texels
        pair = int(self.light_order[light] + len(self.lights) * self.view_order[view])
        rgb = self._rgb(slice(pair, pair + 1), slice(0, height * width)).reshape(height, width, 3).flip(0)
        return self._checked(rgb * self.foreshortening[light])

    def _rgb(self, pairs: slice, texels: slice) -> Float[Tensor, "pair texel 3"]:
        with store.reading(self.file.path):
            return btfdbb_colour.to_rgb(self.file.colour, self.file.body.values(pairs, texels))

    def _checked(self, T: Tensor) -> Tensor:
        check_finite(f"{self.file.path}: values", T, -LARGEST, LARGEST)
        return T


def survey(path: str | Path, *, rank: int | None = None) -> File:
    """Return what a `.btf` file holds, whatever its directions are; `rank` components of it where that is given.

    Raises:
        FormatError: the file is missing or damaged, or its layout or colour model is not known.
        ConfigError: `rank` is below 1.
    """
    if rank is not None:
        check_range("rank", rank, 1, 2**31)
    path = Path(path)
    if not path.is_file():
        raise FormatError(f"{path}: expected a Bonn BTF (.btf), found none; check the path")
    with store.reading(path):
        # An empty file cannot be mapped.
        data = np.asarray(np.memmap(path, np.uint8, "r")) if path.stat().st_size else np.zeros(0, np.uint8)
        cursor = Cursor(str(path), data)
        header, body, colour = _parse(cursor, rank)
        if cursor.at != len(data):
            raise FormatError(f"{path}: header says {cursor.at} bytes, file holds {len(data)}; the copy may be damaged")
    return File(path=str(path), header=header, body=body, colour=colour)


def _parse(cursor: Cursor, rank: int | None) -> tuple[Header, Body, Colour]:
    header = btfdbb_header.read(cursor)
    match header.signature[1:4]:
        case "DFM":
            return header, *btfdbb_body.read_dfmf(cursor, header, rank)
        case "FMF":
            return header, *btfdbb_body.read_fmf(cursor, header, rank)
        case "PVF":
            return header, *btfdbb_body.read_pvf(cursor, header, rank)
        case _:
            body, rotations = btfdbb_bdi.read(cursor, header)
            return replace(header, rotations=rotations), body, Colour(0)


def load(path: str | Path, *, rank: int | None = None, cosine: bool | None = None) -> BonnBtf:
    """Return the BTF of a `.btf` file; it stays on disk until a part is asked for.

    Args:
        path: of the file.
        rank: components read of each factorisation; none = all, and plain chunks have none.
        cosine: whether values hold cos(theta_i); none = what the file says.

    Raises:
        FormatError: the file is missing or damaged, its layout or colour model is not known, or its directions are no
            rings of even steps.
        ConfigError: `rank` is below 1.
    """
    file = survey(path, rank=rank)
    lights, views = file.directions()
    told = file.header.cosine if cosine is None else cosine
    cos_theta = torch.from_numpy(file.header.lights.astype(np.float64))[lights.order, 0].cos().float()
    return BonnBtf(
        file=file,
        lights=lights.directions,
        views=views.directions,
        light_order=lights.order,
        view_order=views.order,
        foreshortening=cos_theta if told is False else torch.ones_like(cos_theta),
    )


def read(path: str | Path, *, rank: int | None = None, limit: float = MEMORY_LIMIT) -> Btf:
    """Return the BTF of a `.btf` file, decoded into memory as float32.

    Raises:
        SizeError: it would take more than `limit` bytes.
        MesoError: as `load`, and `BonnBtf.rows`.
    """
    found = load(path, rank=rank)
    height, width = found.texels
    row_bytes = len(found.lights) * len(found.views) * width * 3 * 4
    check_memory(str(path), row_bytes * height, limit, "read it in bands (data.btfdbb.load), or compress it first")
    images = torch.empty(len(found.lights), len(found.views), height, width, 3)
    step = max(1, BLOCK_BYTES // row_bytes)
    for start in range(0, height, step):
        images[:, :, start : start + step] = found.rows(start, start + step)
    return Btf(images=images, lights=found.lights, views=found.views)

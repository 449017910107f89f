"""Maps that a fit computes in bands of texel rows and needs one by one: kept in a job's parts (`data.journal`).

Fits read a table in bands, all directions at once; codes need the range of a whole map, and files hold map after map.
One part holds all maps of a piece of a band, `ROOM` at most, so that maps of float32 take no more memory than the bytes
that they are computed from. A fit that was stopped goes on behind the last piece it kept, and collecting a map reads
that map alone. The codes of a map lie with the texel rows outermost: what all of them show of a few rows is
read without the others.

Test: tests/compress/test_kept_maps.py
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchmeso.data import bands
from torchmeso.data.btf import Bands
from torchmeso.data.journal import Parts

ROOM = 64 << 20
"""Memory of the maps of a piece of a band."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptMaps:
    """Maps (..., H, ...) of the whole texture, in bands.

    Attributes:
        parts: of the job.
        name: of the maps in it.
        layout: bands of texel rows that the table is read in.
        count: maps.
        before: axes of a map before its texel rows.
        after: axes behind them.
        dtype: of the values.
    """

    parts: Parts
    name: str
    layout: tuple[slice, ...]
    count: int
    before: tuple[int, ...]
    after: tuple[int, ...]
    dtype: torch.dtype

    @property
    def step(self) -> int:
        """Texel rows of a piece."""
        row = math.prod((self.count, *self.before, *self.after)) * self.dtype.itemsize
        return max(1, ROOM // row)

    def todo(self) -> list[slice]:
        """Return the bands that are not all there yet, from their first piece that is missing on."""
        found = []
        for band in self.layout:
            missing = [piece for piece in pieces(band, self.step) if not self._has(piece)]
            if missing:
                found.append(slice(missing[0].start, band.stop))
        return found

    def keep(
        self,
        computed: Iterable[tuple[slice, Shaped[Tensor, "map *axes"]]],
        progress: Callable[[float], None] = lambda share: None,
    ) -> None:
        """Keep pieces of all maps as they are computed; `progress` is called with the share of the texture."""
        for rows, values in computed:
            for piece in pieces(rows, self.step):
                first = piece.start - rows.start
                self._write(piece, values.narrow(1 + len(self.before), first, piece.stop - piece.start))
            progress(rows.stop / self.layout[-1].stop)

    def keep_rows(
        self,
        btf: Bands,
        of_row: Callable[[Float[Tensor, "light view W 3"]], Shaped[Tensor, "map *axes"]],
        progress: Callable[[float], None] = lambda share: None,
    ) -> None:
        """Keep what is not there yet, computed texel row by texel row; black rows have maps of zeros and cost nothing.

        Raises:
            FormatError: the file on disk is damaged.
            ShapeError: a value of the BTF is not finite.
        """
        for band in bands.ahead(btf, self.todo()):
            for piece in pieces(band.rows, self.step):
                found = torch.zeros(self._shape(piece), dtype=self.dtype)
                for at in range(piece.stop - piece.start):
                    samples = bands.linear_row(btf, band, piece.start - band.rows.start + at)
                    if bool(samples.any()):
                        found.select(1 + len(self.before), at).copy_(of_row(samples))
                self._write(piece, found)
            progress(band.rows.stop / self.layout[-1].stop)

    def collected(self, first: int, count: int = 1) -> Shaped[Tensor, "map *axes"]:
        """Return `count` whole maps, reading no others."""
        height, axis = self.layout[-1].stop, 1 + len(self.before)
        found = torch.empty(count, *self.before, height, *self.after, dtype=self.dtype)
        for rows in self._pieces():
            part = self.parts.read(self._part(rows), self._shape(rows), self.dtype, first=first, count=count)
            found.narrow(axis, rows.start, rows.stop - rows.start).copy_(part)
        return found

    def row(self, row: int) -> Shaped[Tensor, "map *axes"]:
        """Return all maps of one row of texels; its piece is read."""
        rows = next(rows for rows in self._pieces() if row < rows.stop)
        part = self.parts.read(self._part(rows), self._shape(rows), self.dtype)
        return part.select(1 + len(self.before), row - rows.start)

    def drop(self) -> None:
        """Forget the maps."""
        for rows in self._pieces():
            self.parts.drop(self._part(rows))

    def _write(self, piece: slice, values: Tensor) -> None:
        self.parts.write(self._part(piece), values.contiguous())

    def _pieces(self) -> list[slice]:
        return [piece for band in self.layout for piece in pieces(band, self.step)]

    def _has(self, rows: slice) -> bool:
        return self.parts.has(self._part(rows), self._shape(rows), self.dtype)

    def _part(self, rows: slice) -> str:
        return f"{self.name}.{rows.start}-{rows.stop}"

    def _shape(self, rows: slice) -> tuple[int, ...]:
        return self.count, *self.before, rows.stop - rows.start, *self.after


def pieces(band: slice, step: int) -> list[slice]:
    """Return `band` in pieces of `step` rows of texels, the last one as many as are left."""
    return [slice(start, min(start + step, band.stop)) for start in range(band.start, band.stop, step)]


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptCodes:
    """Codes of maps, each with a scale and an offset for each of its three channels.

    Attributes:
        parts: of the job.
        name: of the codes in it.
        count: maps.
        shape: of a map, its texel rows first, its channels last.
        dtype: of the codes.
    """

    parts: Parts
    name: str
    count: int
    shape: tuple[int, ...]
    dtype: torch.dtype

    def complete(self) -> bool:
        """Return whether the codes of all maps are there."""
        return all(self.parts.has(f"{self.name}.{k}", self.shape, self.dtype) for k in range(self.count))

    def keep(self, k: int, codes: Shaped[Tensor, "H *axes"], scale: Tensor, offset: Tensor) -> None:
        """Keep the codes of map k, value = offset + scale * code."""
        self.parts.write(f"{self.name}.scale.{k}", torch.stack([scale, offset]))
        self.parts.write(f"{self.name}.{k}", codes.contiguous())

    def of_map(self, k: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the codes, scale and offset of map k."""
        return (self.parts.read(f"{self.name}.{k}", self.shape, self.dtype), *self._scale(k))

    def opened(self, rows: slice) -> Callable[[int], Float[Tensor, "map *axes"]]:
        """Return a function that gives the values of all maps in row 0, 1, ... of a band, which is read here."""
        count = rows.stop - rows.start
        codes = [
            self.parts.read(f"{self.name}.{k}", self.shape, self.dtype, first=rows.start, count=count)
            for k in range(self.count)
        ]
        scales = [self._scale(k) for k in range(self.count)]

        def row(at: int) -> Tensor:
            pairs = zip(codes, scales, strict=True)
            return torch.stack([offset + scale * x[at].float() for x, (scale, offset) in pairs])

        return row

    def drop(self) -> None:
        """Forget the codes."""
        for k in range(self.count):
            self.parts.drop(f"{self.name}.{k}")
            self.parts.drop(f"{self.name}.scale.{k}")

    def _scale(self, k: int) -> tuple[Tensor, Tensor]:
        scale, offset = self.parts.read(f"{self.name}.scale.{k}", (2, 3), torch.float32)
        return scale, offset

"""BTFs that lie about as pictures, one file per light and view, and their way into a raw table.

A `PictureSet` knows which file shows which pair of directions and how one is read; `data.ubo2003` and
`data.exr_stack` make them. `to_table` streams one into a raw table (.btf.zarr), a view at a time: it resumes where it
was stopped, decodes ahead of the writing, and keeps sRGB codes as bytes, so that a set of 12.6 GB never becomes
floats on disk. Pictures that are missing can be filled in from those present: over the lights of their view (as
T / cos(theta_i), which varies less than T; `geometry.gaps`), and views without any picture over the other views.

Test: tests/data/test_picture_set.py
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import torch
from jaxtyping import Bool, Shaped
from torch import Tensor

from torchmeso.data import bands, btf, image, store
from torchmeso.data.btf import Btf, Encoding
from torchmeso.errors import FormatError, check_memory
from torchmeso.geometry import gaps
from torchmeso.geometry.hemisphere import DirectionSet

Pair = tuple[int, int]
"""Light and view."""

Reader = Callable[[str], Tensor]
"""Returns the picture of that name, (H, W, 3): uint8 sRGB codes or linear float32."""

Progress = Callable[[float], None]

THREADS = 2
AHEAD = 8
"""Pictures being decoded while others are written."""

ROWS = 16
"""Rows of texels in a chunk, at most: fits read bands of them, over all lights and views (`bands.ROOM`)."""

SHARD_BYTES = 128 << 20
"""About what is encoded at once."""

LIMIT = 4 << 30
"""Memory that `read` takes at most."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PictureSet:
    """Which file shows which directions.

    Attributes:
        name: of the folder or archive.
        lights: directions towards the light.
        views: directions towards the viewer.
        files: name of the picture of (light, view), as `opened` knows it.
        encoding: of the pictures.
        key: changes when a file does.
        opened: a context that gives the function which reads a picture.
    """

    name: str
    lights: DirectionSet
    views: DirectionSet
    files: Mapping[Pair, str]
    encoding: Encoding
    key: str
    opened: Callable[[], AbstractContextManager[Reader]]

    @property
    def n_missing(self) -> int:
        """Pairs that have no picture."""
        return len(self.lights) * len(self.views) - len(self.files)

    def missing(self) -> Iterator[Pair]:
        """Yield the pairs that have no picture, view by view."""
        pairs = ((l, v) for v in range(len(self.views)) for l in range(len(self.lights)))
        return (pair for pair in pairs if pair not in self.files)

    def missing_text(self, first: int = 3) -> str:
        """Return how many pictures are missing, and the `first` of them by their angles in degrees."""
        if not self.n_missing:
            return "none"
        lights, views = gaps.angles_deg(self.lights), gaps.angles_deg(self.views)
        named = [
            "tl{:03g} pl{:03g} tv{:03g} pv{:03g}".format(*lights[l], *views[v])  # as files are named
            for l, v in islice(self.missing(), first)
        ]
        more = f" and {self.n_missing - first} more" if self.n_missing > first else ""
        return f"{self.n_missing} of {len(self.lights) * len(self.views)} ({', '.join(named)}{more})"


def by_place(
    path: str, angles: Mapping[str, tuple[gaps.Angles, gaps.Angles]], lights: DirectionSet, views: DirectionSet
) -> dict[Pair, str]:
    """Return the file of each pair, from the angles (light, view) that each file has.

    Raises:
        FormatError: a direction is none of the set, or two files show the same pair.
    """
    files: dict[Pair, str] = {}
    names = sorted(angles)
    light_places = gaps.locate(lights, [angles[name][0] for name in names])
    view_places = gaps.locate(views, [angles[name][1] for name in names])
    for name, light, view in zip(names, light_places, view_places, strict=True):
        if light is None or view is None:
            what, directions = ("light", lights) if light is None else ("view", views)
            raise FormatError(f"{path}: the {what} of '{name}' is none of {directions.name}")
        if (light, view) in files:
            raise FormatError(f"{path}: two pictures show the same directions: '{files[light, view]}' and '{name}'")
        files[light, view] = name
    return files


def size(pictures: PictureSet) -> tuple[int, int]:
    """Return height and width of the pictures; only the first one is read.

    Raises:
        FormatError: it is damaged.
    """
    with pictures.opened() as reader:
        height, width, _ = reader(next(iter(pictures.files.values()))).shape
        return height, width


def read(pictures: PictureSet, *, allow_missing: bool = False) -> Btf:
    """Return the whole BTF in memory; `to_table` is the way for large ones.

    Raises:
        FormatError: a picture is missing (unless `allow_missing`), damaged, or of another size.
        SizeError: it needs more than `LIMIT`.
    """
    with pictures.opened() as reader:
        shape = _shape(pictures, reader, allow_missing)
        dtype = torch.uint8 if pictures.encoding == "srgb" else torch.float32
        check_memory(pictures.name, math.prod(shape) * dtype.itemsize, LIMIT, "make a table of it and read that")
        images = torch.empty(shape, dtype=dtype)
        for v, block in _blocks(pictures, reader, shape, range(shape[1])):
            images[:, v] = block
    for v, block in _unseen_views(pictures, lambda v: images[:, v]):
        images[:, v] = block
    return Btf(images=images, lights=pictures.lights, views=pictures.views, encoding=pictures.encoding)


def to_table(
    pictures: PictureSet,
    path: str | Path,
    *,
    allow_missing: bool = False,
    progress: Progress = lambda share: None,
    **attributes: object,
) -> None:
    """Write the pictures as the raw table `path` (.btf.zarr), a view at a time, from where an earlier run stopped.

    Codes are stored as uint8, linear pictures as float32. What was filled in is told in the attribute `filled`.

    Raises:
        FormatError: a picture is missing (unless `allow_missing`), damaged, or of another size.
        StorageError: the disk is full, or the place cannot be written to.
    """
    n_view = len(pictures.views)
    with pictures.opened() as reader:
        shape = _shape(pictures, reader, allow_missing)
        attributes = {
            **btf.table_attributes(pictures.lights, pictures.views, 0.0, pictures.encoding),
            "source_key": pictures.key,
            **({"filled": pictures.missing_text(10)} if pictures.n_missing else {}),
            **attributes,
        }
        with store.writing(path):
            writer = store.open_blocks(path, specs(shape, pictures.encoding), attributes)
            table = writer["images"]
            todo = [v for v in range(n_view) if not writer.is_done(v)]
            for v, block in _blocks(pictures, reader, shape, todo):
                table[:, v] = block.numpy()
                writer.mark_done(v)
                progress((v + 1) / n_view)
            for v, block in _unseen_views(pictures, lambda v: torch.from_numpy(table[:, v])):
                table[:, v] = block.numpy()
            writer.finish()


def check_complete(pictures: PictureSet) -> None:
    """Raise FormatError if a picture is missing."""
    if pictures.n_missing:
        raise FormatError(
            f"{pictures.name}: pictures are missing: {pictures.missing_text()}; "
            "find them, or let them be interpolated (--allow-missing)"
        )


def _shape(pictures: PictureSet, reader: Reader, allow_missing: bool) -> tuple[int, ...]:
    if not allow_missing:
        check_complete(pictures)
    height, width, _ = reader(next(iter(pictures.files.values()))).shape
    return len(pictures.lights), len(pictures.views), height, width, 3


def specs(shape: tuple[int, ...], encoding: Encoding) -> dict[str, store.ArraySpec]:
    """Return the layout for fits, which read bands of rows over all lights."""
    light, _, height, width, _ = shape
    dtype, size = ("uint8", 1) if encoding == "srgb" else ("float32", 4)
    fitting = max(1, min(ROWS, bands.ROOM // (light * shape[1] * width * 3 * size)))
    spec = btf.specs(shape, dtype, chunk=(light, 1, fitting, width, 3))["images"]
    chunk_rows = spec.chunks[2]
    rows = chunk_rows * max(1, SHARD_BYTES // (light * chunk_rows * width * 3 * size))
    return {"images": replace(spec, shards=(light, 1, min(rows, -(-height // chunk_rows) * chunk_rows), width, 3))}


def _blocks(
    pictures: PictureSet, reader: Reader, shape: tuple[int, ...], views: Iterable[int]
) -> Iterator[tuple[int, Shaped[Tensor, "light H W 3"]]]:
    """Yield each of `views` with the pictures of all its lights; a view without any picture is left black."""
    views = list(views)
    n_light, _, height, width, _ = shape
    names = [pictures.files[l, v] for v in views for l in range(n_light) if (l, v) in pictures.files]
    decoded = _ahead(reader, names)
    for v in views:
        present = torch.tensor([(l, v) in pictures.files for l in range(n_light)])
        block = torch.zeros(
            n_light, height, width, 3, dtype=torch.uint8 if pictures.encoding == "srgb" else torch.float32
        )
        for l in present.nonzero()[:, 0].tolist():
            picture = next(decoded)
            _check_size(pictures, pictures.files[l, v], picture, (height, width))
            block.numpy()[l] = picture.numpy()  # torch would wake all its threads for each picture
        if bool(present.any()) and not bool(present.all()):
            _fill_lights(pictures, block, present)
        yield v, block


def _check_size(pictures: PictureSet, name: str, picture: Tensor, size: tuple[int, int]) -> None:
    if tuple(picture.shape[:2]) != size:
        height, width = picture.shape[:2]
        raise FormatError(
            f"{pictures.name}: expected pictures of {size[1]} x {size[0]} as the first one, "
            f"got {width} x {height}: {name}"
        )


def _ahead(read: Callable[[str], Tensor], names: list[str]) -> Iterator[Tensor]:
    """Yield the pictures in order, while the next ones are read and decoded."""
    pool = ThreadPoolExecutor(THREADS)
    waiting: deque[Future[Tensor]] = deque()
    try:
        for name in names:
            waiting.append(pool.submit(read, name))
            if len(waiting) > AHEAD:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def _fill_lights(pictures: PictureSet, block: Tensor, present: Bool[Tensor, "light"]) -> None:
    """Put what is missing into `block`: T / cos(theta_i) weighed over the lights that are there."""
    weights = gaps.filling(pictures.lights, present)
    cosine = pictures.lights.directions(torch.float64)[:, 2]
    for l in (~present).nonzero()[:, 0].tolist():
        block[l] = _mix(block, weights[l] * cosine[l] / cosine)


def _unseen_views(
    pictures: PictureSet, block: Callable[[int], Tensor]
) -> Iterator[tuple[int, Shaped[Tensor, "light H W 3"]]]:
    """Yield the views of which there is no picture, each weighed over the other views."""
    seen = {v for _, v in pictures.files}
    present = torch.tensor([v in seen for v in range(len(pictures.views))])
    if bool(present.all()):
        return
    weights = gaps.filling(pictures.views, present)
    for v in (~present).nonzero()[:, 0].tolist():
        used = weights[v].nonzero()[:, 0].tolist()
        total = sum(float(weights[v, other]) * _linear(block(other)) for other in used)
        assert isinstance(total, Tensor)
        yield v, image.encode_codes(total) if pictures.encoding == "srgb" else total


def _mix(block: Tensor, weights: Tensor) -> Tensor:
    total = torch.zeros(block.shape[1:], dtype=torch.float32)
    for l in weights.nonzero()[:, 0].tolist():
        total += float(weights[l]) * _linear(block[l])
    return image.encode_codes(total) if block.dtype == torch.uint8 else total


def _linear(stored: Tensor) -> Tensor:
    return image.decode_codes(stored) if stored.dtype == torch.uint8 else stored

"""Parts of a long job, kept beside the file it makes: the same job goes on from them after it was stopped or killed.

`<file>.part` is a folder with one file of plain numbers for each part, written beside and renamed, and `key`, which
says whose they are; another job throws them away. They are gone when the job is done. A job that makes no file keeps
its parts `InMemory`, by the same calls.

Test: tests/data/test_journal.py
"""

import math
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from torchmeso.data import store
from torchmeso.errors import FormatError


@runtime_checkable
class Parts(Protocol):
    """Parts of a job by name: a `Journal`, or `InMemory`."""

    def has(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> bool:
        """Return whether the part `name` is there."""
        ...

    def write(self, name: str, values: Tensor) -> None:
        """Keep a part, in the place of one that has its name."""
        ...

    def read(
        self, name: str, shape: tuple[int, ...], dtype: torch.dtype, *, first: int = 0, count: int | None = None
    ) -> Tensor:
        """Return a part, or the `count` from `first` on along its first axis."""
        ...

    def drop(self, name: str) -> None:
        """Forget a part, where there is one."""
        ...


@dataclass(frozen=True, slots=True)
class InMemory:
    """Parts of a job that are gone with it."""

    parts: dict[str, Tensor] = field(default_factory=dict)

    def has(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> bool:
        """Return whether the part `name` is there."""
        return name in self.parts and (tuple(self.parts[name].shape), self.parts[name].dtype) == (shape, dtype)

    def write(self, name: str, values: Tensor) -> None:
        """Keep a part."""
        self.parts[name] = values

    def read(
        self, name: str, shape: tuple[int, ...], dtype: torch.dtype, *, first: int = 0, count: int | None = None
    ) -> Tensor:
        """Return a part, or the `count` from `first` on along its first axis."""
        assert self.has(name, shape, dtype), name
        return self.parts[name][first : None if count is None else first + count]

    def drop(self, name: str) -> None:
        """Forget a part."""
        self.parts.pop(name, None)


@dataclass(frozen=True, slots=True)
class Journal:
    """Where the parts lie; use `beside`."""

    folder: Path

    def has(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> bool:
        """Return whether an earlier run finished the part `name`."""
        path = self.folder / name
        return path.is_file() and path.stat().st_size == math.prod(shape) * dtype.itemsize

    def write(self, name: str, values: Tensor) -> None:
        """Keep a part.

        Raises:
            StorageError: the disk is full, or the place cannot be written to.
        """
        beside = self.folder / f"{name}.partial"
        with store.writing(self.folder.with_suffix("")):
            beside.write_bytes(values.contiguous().numpy().data)
            os.replace(beside, self.folder / name)

    def read(
        self, name: str, shape: tuple[int, ...], dtype: torch.dtype, *, first: int = 0, count: int | None = None
    ) -> Tensor:
        """Return a part, or the `count` from `first` on along its first axis; nothing else is read.

        Raises:
            FormatError: it is not whole.
        """
        count = shape[0] - first if count is None else count
        inner = math.prod(shape[1:])
        kind = torch.empty(0, dtype=dtype).numpy().dtype
        with store.reading(self.folder / name):
            found = np.fromfile(self.folder / name, kind, count * inner, offset=first * inner * dtype.itemsize)
        if len(found) != count * inner:
            raise FormatError(f"{self.folder / name}: expected {count * inner} numbers, got {len(found)}; remove it")
        return torch.from_numpy(found).reshape(count, *shape[1:])

    def drop(self, name: str) -> None:
        """Forget a part: it is needed no more, and takes room."""
        (self.folder / name).unlink(missing_ok=True)


@contextmanager
def beside(path: str | Path, key: str) -> Iterator[Journal]:
    """Yield the journal of the job that makes `path`, with what an earlier run of the same `key` left there.

    It is removed when the block ends without error.

    Raises:
        StorageError: the place cannot be written to.
    """
    path = Path(path)
    folder = path.with_name(f"{path.name}.part")
    said = folder / "key"
    with store.writing(path):
        if folder.exists() and not (said.is_file() and said.read_text() == key):
            shutil.rmtree(folder)
        if not folder.exists():
            folder.mkdir(parents=True)
            said.write_text(key)
    yield Journal(folder)
    shutil.rmtree(folder)


def state_of(path: str | Path) -> str:
    """Return a hash of names, sizes and times of the files at `path`: changes when one of them does."""
    path = Path(path)
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    about = [(str(f.relative_to(path)), f.stat().st_size, f.stat().st_mtime_ns) for f in files if f.exists()]
    return store.content_hash(str(path.resolve()), about)

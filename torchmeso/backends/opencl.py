"""OpenCL: the choice of a device, one queue per process, kernels built once per (file, name).

The only module that imports pyopencl. PoCL runs kernels on the CPU; where several platforms are installed
the newest PoCL is taken by its version string, never by index, because the order differs between machines.
TORCHMESO_OPENCL names another: a piece of the platform's name or version.

Kernels: kernels_cl/backends/opencl.cl (a self-test)          Test: tests/backends/test_opencl.py
"""

import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.resources import files
from types import ModuleType
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor

from torchmeso.backends import BackendChoice, processor
from torchmeso.errors import BackendError, human_size

if TYPE_CHECKING:
    import pyopencl as cl
    from pyopencl import Buffer as Buffer

# Pinning PoCL's threads removes a bimodal 1x / 2x in kernels of about a millisecond; read at the first OpenCL call.
os.environ.setdefault("POCL_AFFINITY", "1")

KERNELS = files("kernels_cl")

AVX512, DOT_PRODUCTS = ("avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"), ("avx512vbmi", "avx512vnni")
"""What a processor needs for vectors of sixteen, and for sums of products of bytes, in the compiler's words."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceInfo:
    """What `torchmeso info --device` prints of one OpenCL device.

    Attributes:
        platform: the platform's name.
        version: the platform's version string, which tells two PoCLs apart.
        device: the device's name.
        compute_units: hardware threads.
        global_bytes: memory of the device.
        chosen: whether kernels run here.
    """

    platform: str
    version: str
    device: str
    compute_units: int
    global_bytes: int
    chosen: bool


def list_devices() -> list[DeviceInfo]:
    """Return every OpenCL device of this machine; empty where no platform is installed."""
    try:
        platforms = _pyopencl().get_platforms()
    except BackendError:
        return []
    chosen = _choose(platforms)
    return [
        DeviceInfo(
            platform=platform.name.strip(),
            version=platform.version.strip(),
            device=device.name.strip(),
            compute_units=device.max_compute_units,
            global_bytes=device.global_mem_size,
            chosen=platform == chosen and i == 0,
        )
        for platform in platforms
        for i, device in enumerate(platform.get_devices())
    ]


def resolve(choice: BackendChoice) -> Literal["torch", "opencl"]:
    """Return the backend behind `auto`: opencl where a device works, else torch with one warning."""
    if choice != "auto":
        return choice
    try:
        queue()
    except BackendError as error:
        _warn_once(str(error))
        return "torch"
    return "opencl"


@lru_cache(maxsize=1)
def queue() -> "cl.CommandQueue":
    """Return the queue on the chosen device.

    Raises:
        BackendError: no platform is installed, none matches TORCHMESO_OPENCL, or PoCL's compiler does not know this
            processor and cannot be told.
    """
    cl = _pyopencl()
    device = _choose(cl.get_platforms()).get_devices()[0]
    if device.version.endswith("-generic") and not _rename(device.int_ptr):
        raise BackendError(
            f"opencl: expected a processor that the compiler of {device.platform.version} knows, got "
            f"'{device.name}'; install a younger PoCL, or use the torch backend"
        )
    return cl.CommandQueue(cl.Context([device]), properties=cl.command_queue_properties.PROFILING_ENABLE)


@cache  # the device keeps its new name, and says the old one
def _rename(record: int) -> bool:
    """Give a processor younger than PoCL's compiler a name that it knows; return whether that could be done."""
    name = processor.name_known(processor.flags())
    return name is not None and processor.rename(record, name)


@cache
def kernel(path: str, name: str, options: tuple[str, ...] = ()) -> "cl.Kernel":
    """Build `kernels_cl/<path>` with `options` and return the kernel `name`.

    Raises:
        BackendError: no device, or the build failed; the text carries the compiler's log.
    """
    return _pyopencl().Kernel(_program(path, options), name)


class Call:
    """A kernel with its arguments, ready to be run again and again.

    Keeps its buffers alive: OpenCL does not.
    """

    def __init__(
        self,
        path: str,
        name: str,
        size: tuple[int, ...],
        local: tuple[int, ...],
        arguments: "Sequence[cl.Buffer | np.generic]",
        options: tuple[str, ...] = (),
    ):
        """Take `kernels_cl/<path>`'s kernel `name` over `size` work-items in groups of `local`.

        Raises:
            BackendError: no device, or the build failed.
        """
        self._kernel = _pyopencl().Kernel(_program(path, options), name)
        self._kernel.set_args(*arguments)
        self._size, self._local, self._arguments = size, local, arguments
        self._event: cl.Event | None = None

    def __call__(self) -> None:
        """Put the kernel into the queue."""
        self._event = _pyopencl().enqueue_nd_range_kernel(queue(), self._kernel, self._size, self._local)

    @property
    def milliseconds(self) -> float:
        """Time of the last run, which must have ended; 0 before the first."""
        return 0.0 if self._event is None else 1e-6 * (self._event.profile.end - self._event.profile.start)


def compose(path: str) -> str:
    """Return the source of `kernels_cl/<path>` with every file it includes, each once."""
    seen: set[str] = set()

    def expand(name: str) -> str:
        if name in seen:
            return ""
        seen.add(name)
        text = (KERNELS / name).read_text()
        return re.sub(r'^#include "([^"]+)"\n', lambda found: expand(found[1]), text, flags=re.MULTILINE)

    return expand(path)


@cache
def _program(path: str, options: tuple[str, ...]) -> "cl.Program":
    cl = _pyopencl()
    source = compose(path)
    failure: Exception | None = None
    # A compiler that does not know the attributes builds for what it knows.
    for text in (_widened(source), source) if _instructions() else (source,):
        program = cl.Program(queue().context, text)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", cl.CompilerWarning)  # the compiler's remarks are ours, not the user's
                return program.build(["-cl-std=CL1.2", *options])
        except cl.Error as error:
            failure = error
    raise BackendError(f"kernels_cl/{path} did not build:\n{failure}") from failure


def _widened(source: str) -> str:
    """Return a kernel's source, built for the instructions that the processor has.

    PoCL builds for what its compiler knows of the processor, which for one younger than the compiler is AVX2; vectors
    of sixteen are then split in two. HAS_AVX512 and HAS_DOT_PRODUCTS tell kernels of the instructions they may use.
    """
    wanted = _instructions()
    return (
        "#pragma clang attribute push(__attribute__((min_vector_width(512))), apply_to = function)\n"
        f'#pragma clang attribute push(__attribute__((target("{",".join(wanted)}"))), apply_to = function)\n'
        f"#define HAS_AVX512\n{'#define HAS_DOT_PRODUCTS' * (set(DOT_PRODUCTS) <= set(wanted))}\n"
        f"{source}\n#pragma clang attribute pop\n#pragma clang attribute pop\n"
    )


@cache
def _instructions() -> tuple[str, ...]:
    """Return `AVX512`, and `DOT_PRODUCTS`, where the chosen device is this processor and it has them."""
    flags = {flag.replace("_", "") for flag in processor.flags()}  # avx512_vnni
    if not _shares_memory() or not flags.issuperset(AVX512):
        return ()
    return AVX512 + DOT_PRODUCTS * flags.issuperset(DOT_PRODUCTS)


def upload(x: np.ndarray) -> "cl.Buffer":
    """Return a buffer with a copy of `x`; of at least a block, so that an empty array is one too."""
    cl = _pyopencl()
    content = np.ascontiguousarray(x)
    if content.nbytes == 0:
        return allocate(64)
    return cl.Buffer(queue().context, cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR, hostbuf=content)


def allocate(size: int) -> "cl.Buffer":
    """Return a buffer of `size` bytes with any content.

    Raises:
        BackendError: the device has no room for it.
    """
    cl = _pyopencl()
    try:
        return cl.Buffer(queue().context, cl.mem_flags.READ_WRITE, size=max(size, 64))
    except cl.Error as error:
        raise BackendError(f"opencl: no room for a buffer of {human_size(size)} ({error})") from error


def copy(source: "cl.Buffer", target: "cl.Buffer", first: int, at: int, size: int) -> None:
    """Copy `size` bytes from byte `first` of one buffer to byte `at` of another."""
    _pyopencl().enqueue_copy(queue(), target, source, src_offset=first, dst_offset=at, byte_count=size)


def store(x: np.ndarray, target: "cl.Buffer", at: int) -> None:
    """Copy `x` to byte `at` of a buffer, and wait for that."""
    _pyopencl().enqueue_copy(queue(), target, x, dst_offset=at, is_blocking=True)


class Shared:
    """An array that host and device both read and write, a few values per frame.

    Attributes:
        array: the host's side; change it only while no kernel runs.
        buffer: the device's.
    """

    def __init__(self, x: np.ndarray):
        """Take memory for `x`, on a border of 64 bytes, and copy it there."""
        cl = _pyopencl()
        room = np.zeros(max(x.nbytes, 64) + 64, np.uint8)
        first = -room.ctypes.data % 64
        self.array = room[first : first + x.nbytes].view(x.dtype).reshape(x.shape)
        self.array[...] = x
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR
        self.buffer = cl.Buffer(queue().context, flags, hostbuf=room[first : first + max(x.nbytes, 64)])

    def send(self) -> None:
        """Make what the host wrote visible to kernels that are put into the queue from now on."""
        _exchange(self.buffer, self.array, _pyopencl().map_flags.WRITE)

    def receive(self) -> np.ndarray:
        """Wait for the queue and return what kernels wrote."""
        _exchange(self.buffer, self.array, _pyopencl().map_flags.READ)
        queue().finish()
        return self.array


def _exchange(device: "cl.Buffer", x: np.ndarray, way: int) -> None:
    """Map and unmap a buffer over the host's memory; a device that works in that memory need not be told."""
    if _shares_memory():
        return
    mapped, _ = _pyopencl().enqueue_map_buffer(queue(), device, way, 0, x.shape, x.dtype)
    mapped.base.release(queue())


@cache
def _shares_memory() -> bool:
    """Return whether the device is PoCL on this processor, which uses the host's memory as it is."""
    return "pocl" in queue().device.platform.version.lower() and bool(queue().device.host_unified_memory)


def fetch(device: "cl.Buffer", x: np.ndarray) -> np.ndarray:
    """Wait for the queue, copy a buffer into `x` and return it."""
    _pyopencl().enqueue_copy(queue(), x, device, is_blocking=True)
    return x


def units() -> int:
    """Return how many work-items run at once: for kernels whose work-items fetch their own work."""
    return queue().device.max_compute_units


def buffer(x: Tensor) -> "cl.Buffer":
    """Return an OpenCL buffer over the memory of `x`: no copy, so keep both alive while a kernel may run.

    Raises:
        BackendError: `x` is a view that is not contiguous, is not 64-byte aligned, or wants a gradient.
    """
    cl = _pyopencl()
    if x.requires_grad:
        raise BackendError("buffer: no gradient on opencl; use backend='torch' or detach() the inputs")
    if not x.is_contiguous() or x.data_ptr() % 64:
        raise BackendError("buffer: expected a contiguous tensor aligned to 64 bytes; call clone() first")
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR
    return cl.Buffer(queue().context, flags, hostbuf=x.numpy())


def aligned(x: Tensor) -> Tensor:
    """Return `x` as `buffer` takes it: itself, or a copy that is contiguous and begins on a border of 64 bytes."""
    return x if x.is_contiguous() and x.data_ptr() % 64 == 0 else x.contiguous().clone()


def read(pairs: "Sequence[tuple[cl.Buffer, Tensor]]") -> None:
    """Wait for the queue and make what kernels wrote into `buffer`s visible in the tensors they lie over."""
    for device, x in () if _shares_memory() else pairs:
        _exchange(device, x.numpy(), _pyopencl().map_flags.READ)
    queue().finish()


def self_test() -> float:
    """Run a small kernel on the chosen device and return its largest error against torch (0 when sound).

    Raises:
        BackendError: no device, or the kernel did not build.
    """
    x = torch.linspace(-2, 2, 1024).reshape(64, 16)
    y = torch.empty_like(x)
    device_x, device_y = buffer(x), buffer(y)
    kernel("backends/opencl.cl", "self_test")(queue(), (64,), (8,), device_x, device_y)
    read([(device_y, y)])
    return (y - (2 * x + 1)).abs().max().item()


@cache
def _pyopencl() -> ModuleType:
    """Import pyopencl, or say how to get it."""
    try:
        import pyopencl
    except ImportError as error:
        raise BackendError("opencl: pyopencl is not installed; pip install 'pyopencl[pocl]', or use torch") from error
    try:
        pyopencl.get_platforms()
    except pyopencl.LogicError as error:
        raise BackendError(
            "opencl: expected at least one platform, got none; pip install 'pyopencl[pocl]', or use the torch backend"
        ) from error
    return pyopencl


def _choose(platforms: list) -> "cl.Platform":
    """Return the platform TORCHMESO_OPENCL asks for, else the newest PoCL, else the first."""
    wanted = os.environ.get("TORCHMESO_OPENCL")
    if wanted:
        for platform in platforms:
            if wanted.lower() in f"{platform.name} {platform.version}".lower():
                return platform
        have = "; ".join(f"{p.name} {p.version}" for p in platforms)
        raise BackendError(f"TORCHMESO_OPENCL: no platform contains '{wanted}'; installed: {have}")
    pocl = [p for p in platforms if "pocl" in p.version.lower()]
    return max(pocl, key=lambda p: _pocl_version(p.version)) if pocl else platforms[0]


def _pocl_version(version: str) -> tuple[int, ...]:
    found = re.search(r"pocl\s+(\d+)\.(\d+)", version, re.IGNORECASE)
    return tuple(int(n) for n in found.groups()) if found else (0, 0)


@lru_cache(maxsize=1)
def _warn_once(text: str) -> None:
    warnings.warn(f"{text}; running on the torch backend", stacklevel=3)

import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchmeso.backends import opencl
from torchmeso.errors import BackendError


@pytest.fixture
def no_platform(monkeypatch):
    def fail():
        raise BackendError("opencl: expected at least one platform, got none")

    caches = (opencl.queue, opencl.kernel, opencl._program, opencl._warn_once)
    monkeypatch.setattr(opencl, "_pyopencl", fail)
    for cache in caches:
        cache.cache_clear()
    yield
    for cache in caches:
        cache.cache_clear()


def test_self_test_is_exact(device):
    assert opencl.self_test() == 0.0


def test_exactly_one_device_is_chosen(device):
    assert sum(d.chosen for d in opencl.list_devices()) == 1


def test_newest_pocl_wins_whatever_the_order():
    class Platform:
        def __init__(self, name, version):
            self.name, self.version = name, version

    old = Platform("Portable Computing Language", "OpenCL 3.0 PoCL 3.0-rc2  Linux")
    new = Platform("Portable Computing Language", "OpenCL 3.0 PoCL 10.1+debian  Linux")
    other = Platform("Some OpenCL", "OpenCL 3.0 LINUX")
    assert opencl._choose([other, old, new]) is new
    assert opencl._choose([new, old, other]) is new
    assert opencl._choose([other]) is other


def test_environment_chooses_by_name(monkeypatch):
    class Platform:
        name, version = "Portable Computing Language", "OpenCL 3.0 PoCL 3.0-rc2"

    monkeypatch.setenv("TORCHMESO_OPENCL", "pocl 3.0")
    assert opencl._choose([Platform]) is Platform
    monkeypatch.setenv("TORCHMESO_OPENCL", "intel")
    with pytest.raises(BackendError, match="no platform contains 'intel'; installed: Portable"):
        opencl._choose([Platform])


def test_a_processor_without_a_name_is_refused_at_once(device, monkeypatch):
    class Device:
        version, name = "OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-generic", "some"
        int_ptr = 0

    class Platform:
        name, version = "Portable Computing Language", "OpenCL 3.0 PoCL 3.0"

        def get_devices(self):
            Device.platform = self
            return [Device]

    monkeypatch.setattr(opencl, "_choose", lambda platforms: Platform())
    monkeypatch.setattr(opencl, "_rename", lambda record: False)
    with pytest.raises(BackendError, match=r"PoCL 3\.0 knows, got 'some'; install a younger PoCL, or use the torch"):
        opencl.queue.__wrapped__()


def test_auto_falls_back_to_torch_with_one_warning(no_platform):
    with pytest.warns(UserWarning, match="got none; running on the torch backend"):
        assert opencl.resolve("auto") == "torch"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert opencl.resolve("auto") == "torch"
    assert opencl.list_devices() == []


def test_explicit_choice_is_kept(no_platform):
    assert opencl.resolve("opencl") == "opencl"
    assert opencl.resolve("torch") == "torch"


@pytest.mark.errors
def test_buffers_refuse_gradients_and_views(device):
    with pytest.raises(BackendError, match="no gradient on opencl"):
        opencl.buffer(torch.zeros(4, requires_grad=True))
    assert opencl.aligned(torch.zeros(64)[1:]).data_ptr() % 64 == 0
    with pytest.raises(BackendError, match="contiguous tensor aligned to 64 bytes"):
        opencl.buffer(torch.zeros(64)[1:])


def test_build_failure_carries_the_log(device, tmp_path, monkeypatch):
    (tmp_path / "broken.cl").write_text("__kernel void broken() { nonsense; }")
    monkeypatch.setattr(opencl, "KERNELS", tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(BackendError, match=r"(?s)kernels_cl/broken\.cl did not build:.*nonsense"):
            opencl.kernel("broken.cl", "broken")


def test_a_file_is_composed_of_what_it_includes_once():
    source = opencl.compose("render/renderer.cl")
    assert "#include" not in source
    assert source.count("static float16 atan2_(") == 1
    assert source.index("static Taps bilinear(") < source.index("static float16 mdf_distance(")


def test_kernels_build_where_the_compiler_knows_no_attributes(device, monkeypatch):
    monkeypatch.setattr(opencl, "_instructions", lambda: ("no such thing",))
    assert opencl._program.__wrapped__("backends/opencl.cl", ()) is not None


def test_what_the_host_shares(device):
    shared = opencl.Shared(np.arange(5, dtype=np.float32))
    assert shared.array.ctypes.data % 64 == 0
    shared.array[2] = 7
    shared.send()
    assert shared.receive().tolist() == [0, 1, 7, 3, 4]
    assert opencl.fetch(opencl.upload(np.arange(3)), np.zeros(3, int)).tolist() == [0, 1, 2]


def test_a_call_keeps_its_time(device):
    x, y = torch.ones(64, 16), torch.zeros(64, 16)
    call = opencl.Call("backends/opencl.cl", "self_test", (64,), (8,), [opencl.buffer(x), opencl.buffer(y)])
    assert call.milliseconds == 0
    call()
    opencl.read([])
    assert call.milliseconds > 0
    assert (y == 3).all()


@pytest.mark.errors
def test_no_room_on_the_device(device):
    with pytest.raises(BackendError, match=r"opencl: no room for a buffer of .* TiB"):
        opencl.allocate(1 << 50)


@pytest.mark.errors
def test_what_is_not_installed_is_said(monkeypatch):
    find = opencl._pyopencl.__wrapped__
    package = SimpleNamespace(LogicError=KeyError, get_platforms=lambda: {}["platforms"])
    monkeypatch.setitem(sys.modules, "pyopencl", package)
    with pytest.raises(BackendError, match="expected at least one platform, got none"):
        find()
    monkeypatch.setitem(sys.modules, "pyopencl", None)
    with pytest.raises(BackendError, match="pyopencl is not installed"):
        find()

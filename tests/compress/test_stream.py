import pytest
import torch

from torchmeso.compress import double_sh, eigen, factored, sh_pca, stream
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.factored import FactoredOptions
from torchmeso.compress.sh_pca import ShPcaOptions
from torchmeso.data import bands, btf, eigen_btf, factored_btf, sh_btf, sh_pca_btf, store
from torchmeso.data.btf import Btf
from torchmeso.data.mdf import Mdf
from torchmeso.errors import ConfigError
from torchmeso.geometry import hemisphere

LIGHTS, VIEWS = hemisphere.grid(6, 3, 80), hemisphere.grid(5, 3, 75)
OPTIONS = {
    "double-sh": DoubleShOptions(light_terms=9, view_terms=4),
    "double-sh float16": DoubleShOptions(light_terms=4, view_terms=9, storage="float16"),
    "double-sh adaptive": DoubleShOptions(light_terms=4, view_terms=9, storage="adaptive"),
    "sh-pca": ShPcaOptions(rank=5, light_terms=9),
    "sh-pca trained": ShPcaOptions(rank=3, light_terms=4, training=20, storage="float16"),
    "factored": FactoredOptions(rank=4),
    "eigen": EigenOptions(rank=3),
    "eigen adaptive": EigenOptions(rank=3, storage="adaptive"),
    "eigen float32": EigenOptions(rank=2, storage="float32"),
}

BANDS = [name for name in OPTIONS if name not in ("factored", "sh-pca trained")]
"""What is kept band by band; factors are kept pass by pass."""


@pytest.fixture
def table(rng, tmp_path, monkeypatch):
    """A table on disk, read a row at a time."""
    images = torch.rand(18, 15, 6, 7, 3, generator=rng)
    images[:, :, 2] = 0
    btf.save(Btf(images=images, lights=LIGHTS, views=VIEWS), tmp_path / "a.btf.zarr", dtype="float32")
    monkeypatch.setattr(bands, "ROOM", 1)
    return btf.load(tmp_path / "a.btf.zarr")


def tensors(path):
    model = store.Model(path)
    return model.meta, {name: model.read(name) for name in sorted(model.names())}


@pytest.mark.parametrize(("name", "depth"), [(n, d) for n in OPTIONS for d in (False, True)])
def test_the_file_is_the_one_of_a_fit_in_memory(name, depth, table, tmp_path, rng):
    mdf = None
    if depth:
        mdf = Mdf(delta=torch.rand(15, 6, 7, generator=rng).half(), no_hit=None, directions=VIEWS, h=0.1)
    options = OPTIONS[name]
    coded = getattr(options, "storage", None) == "adaptive"
    stream.fit(table, options, tmp_path / "a.meso", key="k", backend="torch", silhouette=mdf)
    other = tmp_path / "b.meso"
    if isinstance(options, EigenOptions):
        eigen_btf.save(eigen.fit(table, options), other, silhouette=mdf, coded=coded)
    elif isinstance(options, ShPcaOptions):
        sh_pca_btf.save(sh_pca.fit(table, options), other, silhouette=mdf)
    elif isinstance(options, FactoredOptions):
        factored_btf.save(factored.fit(table, options), other, silhouette=mdf)
    else:
        sh_btf.save(double_sh.fit(table, options), other, silhouette=mdf, coded=coded)
    (meta, streamed), (expected_meta, expected) = tensors(tmp_path / "a.meso"), tensors(tmp_path / "b.meso")
    assert meta == expected_meta
    assert list(streamed) == list(expected)
    assert all(torch.equal(streamed[n], expected[n]) for n in streamed)
    assert not list(tmp_path.glob("*.part"))


class Killed(BaseException):
    """As if the process were gone."""


@pytest.mark.parametrize(
    ("name", "calls"), [(n, k) for n in BANDS for k in ((7,) if "adaptive" in n else (1, 4, 7, 10))]
)
def test_a_fit_that_was_killed_goes_on(name, calls, table, tmp_path, monkeypatch):
    options = OPTIONS[name]
    stream.fit(table, options, tmp_path / "b.meso", key="k", backend="torch")
    told = []

    def dies(share):
        told.append(share)
        if len(told) == calls:
            raise Killed

    with pytest.raises(Killed):
        stream.fit(table, options, tmp_path / "a.meso", key="k", backend="torch", progress=dies)
    assert not (tmp_path / "a.meso").exists()
    read = []
    stored_rows = Btf.stored_rows
    monkeypatch.setattr(Btf, "stored_rows", lambda self, a, b, *c: read.append(a) or stored_rows(self, a, b, *c))
    stream.fit(table, options, tmp_path / "a.meso", key="k", backend="torch")
    passes = 12 if isinstance(options, EigenOptions | ShPcaOptions) else 6
    again = 4 if name == "double-sh adaptive" else 0  # rows that tell what the harmonics leave out
    assert len(read) == max(0, passes - calls) + again
    assert (tmp_path / "a.meso").read_bytes() == (tmp_path / "b.meso").read_bytes()


def test_factors_of_passes_that_ended_are_kept(table, tmp_path, monkeypatch):
    options = OPTIONS["factored"]
    stream.fit(table, options, tmp_path / "b.meso", key="k")

    def dies(share):
        if share > 0.7:
            raise Killed

    with pytest.raises(Killed):
        stream.fit(table, options, tmp_path / "a.meso", key="k", progress=dies)
    told = []
    stream.fit(table, options, tmp_path / "a.meso", key="k", progress=told.append)
    assert min(told) > 0.6
    assert (tmp_path / "a.meso").read_bytes() == (tmp_path / "b.meso").read_bytes()


@pytest.mark.parametrize(
    "other", [{"key": "other"}, {"options": DoubleShOptions(light_terms=9, view_terms=4, energy=2.0)}], ids=str
)
def test_another_job_is_not_gone_on_with(other, table, tmp_path, monkeypatch):
    def dies(share):
        raise Killed

    job = {"key": "k", "options": OPTIONS["double-sh"], "path": tmp_path / "a.meso", "backend": "torch"}
    with pytest.raises(Killed):
        stream.fit(table, progress=dies, **{**job, **other})
    read = []
    stored_rows = Btf.stored_rows
    monkeypatch.setattr(Btf, "stored_rows", lambda self, a, b, *c: read.append(a) or stored_rows(self, a, b, *c))
    stream.fit(table, **job)
    assert len(read) == 6


def test_progress_reaches_one(table, tmp_path):
    for options in OPTIONS.values():
        told = []
        stream.fit(table, options, tmp_path / "a.meso", key="k", backend="torch", progress=told.append)
        assert told == sorted(told)
        assert told[-1] == pytest.approx(1)


@pytest.mark.errors
def test_bad_requests_are_refused_before_anything_is_written(table, tmp_path):
    with pytest.raises(ConfigError, match=r"compress\.rank"):
        stream.fit(table, EigenOptions(rank=16), tmp_path / "a.meso", key="k")
    for options in (DoubleShOptions(light_terms=36), ShPcaOptions(light_terms=36)):
        with pytest.raises(ConfigError, match="expected directions that tell 36 coefficients"):
            stream.fit(table, options, tmp_path / "a.meso", key="k")
    with pytest.raises(ConfigError, match=r"compress\.rank"):
        stream.fit(table, FactoredOptions(rank=43), tmp_path / "a.meso", key="k")
    assert [p.name for p in tmp_path.iterdir()] == ["a.btf.zarr"]

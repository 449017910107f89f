import torch

from torchmeso.data import model_writer, store


def test_a_model_in_parts_is_the_model(tmp_path, rng):
    whole = {
        "codes": torch.randint(0, 256, (3, 5), dtype=torch.uint8, generator=rng),
        "hit": torch.rand(7, generator=rng) > 0.5,
        "half": torch.rand(2, 3, generator=rng).half(),
        "scale": torch.rand(3, 1, generator=rng),
        "exact": torch.rand(2, generator=rng, dtype=torch.float64),
        "nothing": torch.zeros(0, 2),
    }
    layout = {name: (x.dtype, tuple(x.shape)) for name, x in whole.items()}
    with model_writer.in_parts(tmp_path / "a.meso", layout, {"kind": "test"}) as put:
        for name, x in reversed(whole.items()):
            for k in reversed(range(len(x))):
                put(name, x[k : k + 1], k)
        assert not (tmp_path / "a.meso").exists()
    model = store.Model(tmp_path / "a.meso")
    assert model.meta == {"kind": "test", "format": store.FORMAT_VERSION}
    assert sorted(model.names()) == sorted(whole)
    for name, x in whole.items():
        assert torch.equal(model.read(name), x)
    assert [p.name for p in tmp_path.iterdir()] == ["a.meso"]

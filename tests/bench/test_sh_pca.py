from dataclasses import replace

import torch

from tests.pipeline.small import small
from torchmeso.bench import sh_pca
from torchmeso.bench.suite import Context
from torchmeso.bench.timing import Timing
from torchmeso.data.sh_pca_btf import ShPcaBtf
from torchmeso.geometry import hemisphere


def test_rows_on_a_small_brick(monkeypatch):
    """Ids, values and the order of what is compared; frames have a test of their own."""
    options, brick = sh_pca.BtfOptions, sh_pca.generators.brick
    monkeypatch.setattr(sh_pca, "BtfOptions", lambda **k: replace(options(**k), texels=6, views="grid(6, 3, 80)"))
    monkeypatch.setattr(sh_pca.generators, "brick", lambda: brick(rows=6))
    monkeypatch.setattr(sh_pca, "_frames", lambda context: iter(()))
    rows = {row.id.removeprefix("compress.sh_pca."): row for row in sh_pca.rows(Context(quick=True))}
    assert rows["light.36.ridge"].value > rows["light.36.least_squares"].value
    assert rows["light.25.ridge"].value > rows["light.25.cube_map"].value
    assert rows["training.100"].value > rows["training.1000"].value > -0.5
    assert rows["64.ours"].value > rows["64.paper"].value


def test_frames_are_those_of_the_models(monkeypatch, device):
    """Every model is on the scene that is timed."""
    config = small()
    brick = config.materials["brick"]
    finer = replace(brick.btf, texels=4, lights="grid(12, 5, 80)", views="grid(8, 4, 80)")
    config = config.model_copy(
        update={"materials": {**config.materials, "brick": brick.model_copy(update={"btf": finer})}}
    )
    timed, seen = sh_pca.frames.Timed(config, (0.0, 0.0, 3.0), None), []

    def once(calls, **_):
        seen.extend(calls)
        for call in calls.values():
            call()
        return {name: Timing(1.0, 1.0, 1.0, 1.0, 1) for name in calls}

    monkeypatch.setattr(sh_pca.frames, "knot", lambda: timed)
    monkeypatch.setattr(sh_pca, "time_together", once)
    rows = list(sh_pca._frames(Context(quick=True)))
    assert [row.id for row in rows] == [f"compress.sh_pca.frame.{k}" for k in (4, 8, 16)]
    assert all(row.met for row in rows)
    assert len(seen) == 5


def test_what_a_model_shows(rng):
    lights = hemisphere.ubo81()
    model = ShPcaBtf(
        maps=torch.rand(81, 2, 2, 3, generator=rng), scale=torch.ones(3), offset=torch.zeros(3),
        basis=torch.rand(3, 4, 3, generator=rng), lights=lights, views=lights,
    )  # fmt: skip
    wo = lights.directions()[5].expand(81, 3)
    uv = torch.tensor([0.25, 0.25]).expand(81, 2)  # row 1, column 0
    found = sh_pca.shown(model, lights)[:, 5, 1, 0]
    torch.testing.assert_close(model.evaluate(uv, lights.directions(), wo), found, rtol=1e-5, atol=1e-5)
    assert sh_pca.psnr(found + 0.1, found) > sh_pca.psnr(found + 0.2, found)

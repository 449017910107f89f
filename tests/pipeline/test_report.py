import torch

from torchmeso.pipeline import report
from torchmeso.pipeline.bake import Asset
from torchmeso.pipeline.report import Figure, Page
from torchmeso.quality import Comparison
from torchmeso.render.scene import Material


def test_page_shows_every_number_and_escapes_names():
    page = Page(
        title="a <b>",
        figures=[Figure("Picture", "One sentence.", torch.rand(4, 4, 3))],
        comparisons={
            "picture": Comparison(psnr=31.234, ssim=0.9, flip=None, max_error=1.0, exposure=1.0),
        },
        silhouettes=[("picture", 0.98765, 0.25)],
        seconds={"truth": 1.5},
        assets={"brick": Asset(material=Material(), seconds={}, raw_bytes=0, model_bytes=2048)},
        counts={"pixels": 307200},
        machine="a machine",
    )
    html = report.to_html(page)
    expected = (
        "a &lt;b&gt;",
        "31.23",
        "not installed",
        "0.9877",
        "1.500 s",
        "2.0 KiB",
        "307,200",
        "a machine",
        "not here",
    )
    assert [text for text in expected if text not in html] == []
    assert "<script" not in html


def test_machine_names_cores_and_torch():
    assert "cores" in report.machine()
    assert torch.__version__ in report.machine()

import pytest

from tests.pipeline.small import small
from torchmeso import config
from torchmeso.data import image
from torchmeso.errors import FormatError
from torchmeso.pipeline import demo


def test_everything_is_left_in_the_folder(tmp_path):
    paths = demo.run(small(), tmp_path / "out")
    assert all(p.is_file() for p in paths)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(p.name for p in paths)
    picture, plain = image.read(tmp_path / "out" / "picture.exr"), image.read(tmp_path / "out" / "btf_only.png")
    assert picture.shape == plain.shape == (36, 48, 3)
    html = (tmp_path / "out" / "report.html").read_text()
    assert html.count("data:image/png;base64,") == 4
    assert "http" not in html
    assert "intervals carved" in html


def test_built_in_scene_is_found():
    assert config.load(demo.built_in("demo")).name == "demo"


@pytest.mark.errors
def test_unknown_scene():
    with pytest.raises(FormatError, match="expected a built-in configuration"):
        demo.built_in("nothing")

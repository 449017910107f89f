import pytest

from torchmeso.bench import plot
from torchmeso.bench.suite import Row
from torchmeso.errors import FormatError


def row(k, **changes):
    fields = {"id": f"btf.rank.{k}", "what": "x", "value": 30.0, "unit": "dB", "better": "higher"}
    return Row(**{**fields, "curve": {"series": "rank", "x": k, "ms": 3.0}, **changes})


def test_curves_become_a_picture(tmp_path):
    pytest.importorskip("matplotlib")
    rows = [
        row(1),
        row(4),
        row(8, value=None),
        row("uint8", id="btf.storage.uint8", curve={"series": "s", "x": "uint8"}),
    ]
    plot.draw(rows, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.errors
def test_nothing_to_draw(tmp_path):
    with pytest.raises(FormatError, match="expected rows that belong to a curve"):
        plot.draw([row(1, curve=None)], tmp_path / "a.png")

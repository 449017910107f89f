import pytest

from tests.raise_coverage import Watch


def test_what_was_raised_is_told_from_what_was_not(tmp_path):
    path = tmp_path / "a.py"
    path.write_text(
        "def f(x):\n"
        "    if x == 1:\n"
        "        raise ValueError(\n"
        "            f'{x}'\n"
        "        )\n"
        "    if x == 2:\n"
        "        raise KeyError(x)\n"
        "    int('no')\n"
    )  # fmt: skip
    names: dict = {}
    exec(compile(path.read_text(), str(path), "exec"), names)
    watch = Watch(tmp_path)
    with watch:
        for x in (1, 3):
            with pytest.raises(ValueError, match=r"1|no"):
                names["f"](x)
    assert watch.missed() == [(str(path), 7)]
    with watch, pytest.raises(KeyError):
        names["f"](2)
    assert watch.missed() == []

"""The repository keeps its own shape."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
KERNELS = sorted(p.relative_to(ROOT / "kernels_cl") for p in (ROOT / "kernels_cl").rglob("*.cl"))
MODULES = sorted(p.relative_to(ROOT) for p in (ROOT / "torchmeso").rglob("*.py"))


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_kernel_has_host_and_test_of_the_same_name(kernel):
    assert (ROOT / "torchmeso" / kernel.with_suffix(".py")).is_file()
    assert (ROOT / "tests" / kernel.parent / f"test_{kernel.stem}.py").is_file()


@pytest.mark.parametrize("init", [m for m in MODULES if m.name == "__init__.py" and len(m.parts) > 2], ids=str)
def test_init_stays_short(init):
    assert len((ROOT / init).read_text().splitlines()) <= 40


@pytest.mark.parametrize("module", [m for m in MODULES if m.name != "__init__.py"], ids=str)
def test_module_names_a_test_that_exists(module):
    text = (ROOT / module).read_text()
    for test in re.findall(r"^\s*(?:Kernels?:.*)?Tests?:\s*(tests/\S+\.py)", text, re.MULTILINE):
        assert (ROOT / test).is_file(), f"{module} names {test}"


def test_cited_keys_are_in_the_bibliography():
    known = set(re.findall(r"@\w+\{(\w+),", (ROOT / "references.bib").read_text()))
    cited = set()
    for module in MODULES:
        cited |= set(re.findall(r"\b([a-z]+(?:19|20)\d\d[a-z]+)\b", (ROOT / module).read_text()))
    assert cited <= known, f"missing from references.bib: {sorted(cited - known)}"


def test_no_module_is_called_utils():
    assert not [m for m in MODULES if m.stem in {"utils", "util", "helpers", "common"}]

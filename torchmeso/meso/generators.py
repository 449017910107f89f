"""Built-in mesostructures by name. Each is tileable and exact; lengths are in tile units.

    plain     sheet, groove, spheres
    masonry   brick, blocks, grid
    strands   weave, pipes, chain
    natural   grass, squama, peanut
    bark      bark

Closed forms of every shape stand in the tests of these files.

Test: tests/meso/test_generators.py
"""

from collections.abc import Callable

from torchmeso.meso.bark import bark
from torchmeso.meso.masonry import blocks, brick, grid
from torchmeso.meso.mesostructure import Mesostructure
from torchmeso.meso.natural import grass, peanut, squama
from torchmeso.meso.plain import groove, sheet, spheres
from torchmeso.meso.strands import chain, pipes, weave

GENERATORS: dict[str, Callable[..., Mesostructure]] = {
    f.__name__: f
    for f in (sheet, groove, spheres, brick, blocks, grid, weave, pipes, chain, grass, squama, peanut, bark)
}

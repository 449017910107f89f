"""The run-time checker of the second test pass: jaxtyping shapes, with ints accepted where floats are expected."""

from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))

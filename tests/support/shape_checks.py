"""The run-time type checker of the tests, as jaxtyping's import hook calls it."""

from beartype import BeartypeConf, beartype

# As for any static checker, an int is good where a float is asked for.
check = beartype(conf=BeartypeConf(is_pep484_tower=True))

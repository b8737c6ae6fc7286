"""The run-time type checker of shape annotations."""

from beartype import BeartypeConf, beartype

typecheck = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""An int is accepted where a float is annotated."""

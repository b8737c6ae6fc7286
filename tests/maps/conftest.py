"""Fixtures of the tests of map readers."""

import gzip

import pytest
from small_xodr import document

from limsim_jax.maps.network import Network
from limsim_jax.maps.opendrive import read_opendrive


@pytest.fixture
def read(tmp_path):
    """Writes OpenDRIVE elements into a file and reads it."""

    def build(*elements: str, packed: bool = False) -> Network:
        text = document(*elements)
        path = tmp_path / "map.xodr"
        path.write_bytes(gzip.compress(text.encode()) if packed else text.encode())
        return read_opendrive(path)

    return build

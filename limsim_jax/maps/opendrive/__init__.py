"""OpenDRIVE 1.1 to 1.8 to `Network`: `records` (XML), `curves`, `lanes`, `links`, `furniture`, `reader`."""

from limsim_jax.maps.opendrive.reader import read_opendrive as read_opendrive

"""OpenDRIVE 1.1 to 1.8 as a `Network`.

`parser` turns XML into `records`; `curves`, `lanes`, `links` and `furniture` interpret them; `reader` joins
the results.
"""

from limsim_jax.maps.opendrive.reader import read_opendrive as read_opendrive

"""SUMO road networks and demand.

`read_sumo` reads networks (`.net.xml`), `read_demand` routes, vehicles and flows (`.rou.xml`,
`.add.xml`), both also gzipped. The formats are those of
https://sumo.dlr.de/docs/Networks/SUMO_Road_Networks.html and
https://sumo.dlr.de/docs/Definition_of_Vehicles,_Vehicle_Types,_and_Routes.html. What has no place in the
result is counted in its import report, elements and attributes alike.
"""

from limsim_jax.maps.sumo.classes import VEHICLE_CLASSES
from limsim_jax.maps.sumo.demand import read_demand
from limsim_jax.maps.sumo.reader import read_sumo

__all__ = ["VEHICLE_CLASSES", "read_demand", "read_sumo"]

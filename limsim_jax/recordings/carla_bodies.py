"""Sizes of CARLA's vehicles, and the one most like ours.

Bounding boxes of blueprints of CARLA 0.9, as a server gives them (`Actor.bounding_box`), rounded to mm.
The box of `vehicle.lincoln.mkz_2017` equals the one in CARLA's own recorder logs.
"""

from __future__ import annotations

import math
from typing import NamedTuple


class Body(NamedTuple):
    """The body of a blueprint."""

    vehicle_class: str  # of `maps.lane_map.VEHICLE_CLASSES`, or "bicycle"
    length: float  # m
    width: float  # m
    height: float  # m
    ahead: float = 0.0  # m, middle of the body ahead of the actor's origin

    @property
    def wheels(self) -> int:
        """Number of wheels."""
        return 2 if self.vehicle_class in ("motorcycle", "bicycle") else 4


BODIES: dict[str, Body] = {
    "vehicle.audi.a2": Body("car", 3.705, 1.789, 1.549),
    "vehicle.audi.etron": Body("car", 4.856, 2.033, 1.649, -0.004),
    "vehicle.audi.tt": Body("car", 4.181, 1.994, 1.385),
    "vehicle.bh.crossbike": Body("bicycle", 1.509, 0.866, 1.612),
    "vehicle.bmw.grandtourer": Body("car", 4.611, 2.242, 1.667),
    "vehicle.carlamotors.carlacola": Body("truck", 5.204, 2.627, 2.467),
    "vehicle.carlamotors.european_hgv": Body("truck", 7.936, 2.891, 3.462, 0.013),
    "vehicle.carlamotors.firetruck": Body("emergency", 8.468, 2.891, 3.827, -0.253),
    "vehicle.chevrolet.impala": Body("car", 5.357, 2.033, 1.411),
    "vehicle.citroen.c3": Body("car", 3.988, 1.851, 1.617),
    "vehicle.diamondback.century": Body("bicycle", 1.656, 0.582, 1.620),
    "vehicle.dodge.charger_2020": Body("car", 5.008, 1.882, 1.535, -0.005),
    "vehicle.dodge.charger_police": Body("emergency", 4.974, 2.038, 1.542, 0.024),
    "vehicle.dodge.charger_police_2020": Body("emergency", 5.238, 1.930, 1.638, 0.109),
    "vehicle.ford.ambulance": Body("emergency", 6.366, 2.351, 2.431, -0.289),
    "vehicle.ford.crown": Body("car", 5.366, 1.801, 1.575, 0.185),
    "vehicle.ford.mustang": Body("car", 4.718, 1.895, 1.301, 0.032),
    "vehicle.gazelle.omafiets": Body("bicycle", 1.843, 0.659, 1.776, -0.010),
    "vehicle.harley-davidson.low_rider": Body("motorcycle", 2.350, 0.766, 1.649),
    "vehicle.jeep.wrangler_rubicon": Body("car", 3.866, 1.905, 1.878),
    "vehicle.kawasaki.ninja": Body("motorcycle", 2.044, 0.797, 1.523),
    "vehicle.lincoln.mkz_2017": Body("car", 4.902, 2.128, 1.511, 0.004),
    "vehicle.lincoln.mkz_2020": Body("car", 4.892, 1.837, 1.490, -0.006),
    "vehicle.mercedes.coupe": Body("car", 5.027, 2.152, 1.651),
    "vehicle.mercedes.coupe_2020": Body("car", 4.674, 1.812, 1.442, -0.003),
    "vehicle.mercedes.sprinter": Body("van", 5.915, 1.988, 2.561, -0.011),
    "vehicle.micro.microlino": Body("car", 2.207, 1.481, 1.376),
    "vehicle.mini.cooper_s": Body("car", 3.806, 1.970, 1.475),
    "vehicle.mini.cooper_s_2021": Body("car", 4.553, 2.097, 1.767, -0.031),
    "vehicle.mitsubishi.fusorosa": Body("bus", 10.273, 3.944, 4.253, -0.445),
    "vehicle.nissan.micra": Body("car", 3.633, 1.845, 1.501),
    "vehicle.nissan.patrol": Body("car", 4.605, 1.932, 1.855, -0.057),
    "vehicle.nissan.patrol_2021": Body("car", 5.566, 2.150, 2.045, 0.028),
    "vehicle.seat.leon": Body("car", 4.193, 1.816, 1.474),
    "vehicle.tesla.cybertruck": Body("truck", 6.274, 2.390, 2.098),
    "vehicle.tesla.model3": Body("car", 4.792, 2.163, 1.488, 0.029),
    "vehicle.toyota.prius": Body("car", 4.514, 2.007, 1.525, 0.002),
    "vehicle.vespa.zx125": Body("motorcycle", 1.817, 0.866, 1.590, 0.010),
    "vehicle.volkswagen.t2": Body("van", 4.480, 2.069, 2.038, 0.001),
    "vehicle.yamaha.yzf": Body("motorcycle", 2.209, 0.867, 1.530),
}
"""By blueprint. Boxes include mirrors."""

FOUR_WHEELS, TWO_WHEELS = Body("car", 4.6, 1.9, 1.5), Body("bicycle", 1.7, 0.7, 1.6)
"""Of blueprints that the table does not have."""


def body_of(blueprint: str, wheels: int = 4) -> Body:
    """The body of a blueprint; one of usual size for those that are not in the table."""
    return BODIES.get(blueprint, TWO_WHEELS if wheels == 2 else FOUR_WHEELS)


def blueprint_for(vehicle_class: str, length: float, width: float) -> str:
    """The blueprint of this class whose size is nearest.

    Args:
      vehicle_class: of `maps.lane_map.VEHICLE_CLASSES`.
      length: m.
      width: m.

    Raises:
      ValueError: CARLA has no vehicle of this class.
    """
    known = {name: body for name, body in BODIES.items() if body.vehicle_class == vehicle_class}
    if not known:
        classes = sorted({body.vehicle_class for body in BODIES.values()})
        raise ValueError(f"class '{vehicle_class}': CARLA has vehicles of {', '.join(classes)}")
    return min(known, key=lambda name: math.dist(known[name][1:3], (length, width)))


__all__ = ["BODIES", "Body", "blueprint_for", "body_of"]

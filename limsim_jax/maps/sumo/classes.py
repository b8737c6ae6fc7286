"""SUMO's vehicle classes, and the types of lanes for them."""

from __future__ import annotations

from limsim_jax.maps.network import LaneType

VEHICLE_CLASSES = frozenset(
    "private emergency authority army vip pedestrian passenger hov taxi bus coach delivery truck trailer"
    " motorcycle moped bicycle evehicle tram rail_urban rail rail_electric rail_fast ship container"
    " cable_car subway aircraft wheelchair scooter drone custom1 custom2".split()
)
"""Abstract vehicle classes of SUMO 1.28."""

OLD_CLASSES = {
    "public_emergency": "emergency",
    "public_authority": "authority",
    "public_army": "army",
    "public_transport": "bus",
    "transport": "truck",
    "lightrail": "tram",
    "cityrail": "rail_urban",
    "rail_slow": "rail",
}
"""Names of vehicle classes in nets of old versions."""

ENGINE_CLASS = {
    "passenger": "car",
    "evehicle": "car",
    "private": "car",
    "vip": "car",
    "hov": "car",
    "taxi": "car",
    "authority": "car",
    "custom1": "car",
    "custom2": "car",
    "ignoring": "car",
    "delivery": "van",
    "truck": "truck",
    "trailer": "truck",
    "army": "truck",
    "bus": "bus",
    "coach": "bus",
    "motorcycle": "motorcycle",
    "moped": "motorcycle",
    "emergency": "emergency",
}
"""Vehicle class of the engine for a SUMO class; the others are no motor traffic."""

SPECIAL_RIGHTS = frozenset({"emergency", "authority", "army", "vip"})
MOTOR = frozenset("passenger private evehicle delivery truck trailer motorcycle".split())
FOOT = frozenset({"pedestrian", "wheelchair"})
RAIL = frozenset({"rail_urban", "rail", "rail_electric", "rail_fast", "subway"})

TYPE_OF_CLASSES = (
    (frozenset({"bus", "coach"}), LaneType.BUS),
    (frozenset({"taxi"}), LaneType.TAXI),
    (frozenset({"hov"}), LaneType.HOV),
    (frozenset({"tram"}), LaneType.TRAM),
    (RAIL, LaneType.RAIL),
    (frozenset({"bicycle", "moped", "scooter"}), LaneType.BIKING),
    (FOOT, LaneType.SIDEWALK),
    (SPECIAL_RIGHTS | {"custom1", "custom2"}, LaneType.RESTRICTED),
)
"""Lane types of lanes without general motor traffic.

The first group counts of which a class is allowed.
"""

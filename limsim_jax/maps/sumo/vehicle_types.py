"""SUMO's vehicle types, with the defaults of its vehicle classes."""

from __future__ import annotations

import math
import re

from limsim_jax.maps.network import ImportReport
from limsim_jax.maps.sumo.classes import ENGINE_CLASS, OLD_CLASSES, VEHICLE_CLASSES
from limsim_jax.maps.sumo.records import DEFAULT_TYPE, SpeedFactor, VehicleType
from limsim_jax.maps.xml import Element, XmlReader

# https://sumo.dlr.de/docs/Vehicle_Type_Parameter_Defaults.html: length, width, height, min_gap (m), accel,
# decel, emergency_decel (m/s^2), max_speed (km/h), sigma, deviation of the speed factor.
_DEFAULTS = {
    "passenger": (5.0, 1.8, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.1),  # and all that are not listed
    "taxi": (5.0, 1.8, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.05),
    "authority": (5.0, 1.8, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
    "army": (5.0, 1.8, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
    "ignoring": (5.0, 1.8, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
    "emergency": (6.5, 2.16, 2.86, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
    "delivery": (6.5, 2.16, 2.86, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.05),
    "truck": (7.1, 2.4, 2.4, 2.5, 1.3, 4.0, 7.0, 130.0, 0.5, 0.05),
    "trailer": (16.5, 2.55, 4.0, 2.5, 1.1, 4.0, 7.0, 130.0, 0.5, 0.05),
    "bus": (12.0, 2.5, 3.4, 2.5, 1.2, 4.0, 7.0, 100.0, 0.5, 0.0),
    "coach": (14.0, 2.6, 4.0, 2.5, 2.0, 4.0, 7.0, 100.0, 0.5, 0.05),
    "motorcycle": (2.2, 0.9, 1.5, 2.5, 6.0, 10.0, 10.0, 200.0, 0.5, 0.1),
    "moped": (2.1, 0.78, 1.7, 2.5, 1.1, 7.0, 10.0, 60.0, 0.5, 0.1),
    "bicycle": (1.6, 0.65, 1.7, 0.5, 1.2, 3.0, 7.0, 50.0, 0.5, 0.1),
    "scooter": (1.2, 0.5, 1.7, 0.5, 1.2, 3.0, 7.0, 25.0, 0.5, 0.1),
    "pedestrian": (0.215, 0.478, 1.719, 0.25, 1.5, 2.0, 5.0, 37.58, 0.5, 0.1),
    "wheelchair": (1.2, 0.72, 1.2, 0.5, 1.5, 2.0, 5.0, 30.0, 0.5, 0.1),
    "tram": (22.0, 2.4, 3.2, 2.5, 1.0, 3.0, 7.0, 80.0, 0.0, 0.0),
    "rail_urban": (109.5, 3.0, 3.6, 5.0, 1.0, 3.0, 7.0, 100.0, 0.0, 0.0),
    "subway": (109.5, 3.0, 3.6, 5.0, 2.6, 4.5, 9.0, 100.0, 0.5, 0.0),
    "rail": (135.0, 2.84, 3.75, 5.0, 0.25, 1.3, 5.0, 160.0, 0.0, 0.0),
    "rail_electric": (200.0, 2.95, 3.89, 5.0, 0.5, 1.3, 5.0, 220.0, 0.0, 0.0),
    "rail_fast": (200.0, 2.95, 3.89, 5.0, 0.5, 1.3, 5.0, 330.0, 0.0, 0.0),
    "ship": (17.0, 4.0, 4.0, 2.5, 0.1, 0.15, 1.0, 3.6 * 8 / 1.94, 0.0, 0.1),
    "container": (6.096, 2.438, 2.591, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
    "cable_car": (5.0, 1.8, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
    "aircraft": (72.7, 79.8, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
    "drone": (0.5, 0.5, 1.5, 2.5, 2.6, 4.5, 9.0, 200.0, 0.5, 0.0),
}


MODEL_PREFIX = "carFollowing-"
PREDEFINED = {
    DEFAULT_TYPE: "passenger",
    "DEFAULT_PEDTYPE": "pedestrian",
    "DEFAULT_BIKETYPE": "bicycle",
    "DEFAULT_TAXITYPE": "taxi",
    "DEFAULT_RAILTYPE": "rail",
    "DEFAULT_CONTAINERTYPE": "container",
}


def read_vehicle_type(xml: XmlReader, element: Element, report: ImportReport) -> VehicleType:
    """The vehicle type of a `<vType>`. Raises `MapError`."""
    models = [child for child in element if str(child.tag).startswith(MODEL_PREFIX)]
    for child in models:  # the old way to give parameters of the car-following model
        for key, value in child.attrib.items():
            element.set(key, value)
        element.set("carFollowModel", child.tag.removeprefix(MODEL_PREFIX))
    vehicle_class = xml.text(element, "vClass", "passenger")
    vehicle_class = OLD_CLASSES.get(vehicle_class, vehicle_class)
    if vehicle_class not in VEHICLE_CLASSES | {"ignoring"}:
        raise xml.error(element, f"vClass='{vehicle_class[:40]}' is unknown")
    defaults = _DEFAULTS.get(vehicle_class, _DEFAULTS["passenger"])
    length, width, height, min_gap, accel, decel, emergency_decel, max_speed, sigma, deviation = defaults

    def number(attribute: str, value: float, minimum: float = 0.0) -> float:
        return xml.number(element, attribute, value, minimum=minimum)

    decel = number("decel", decel)
    tiny = 1e-9  # these divide
    return VehicleType(
        id=xml.text(element, "id"),
        vehicle_class=vehicle_class,
        engine_class=ENGINE_CLASS.get(vehicle_class),
        model=xml.text(element, "carFollowModel", "Krauss"),
        length=number("length", length, tiny),
        width=number("width", width, tiny),
        height=number("height", height),
        min_gap=number("minGap", min_gap),
        accel=number("accel", accel, tiny),
        decel=decel,
        emergency_decel=number("emergencyDecel", max(decel, emergency_decel)),
        apparent_decel=number("apparentDecel", decel),
        max_speed=number("maxSpeed", max_speed / 3.6, tiny),
        tau=number("tau", 1.0),
        sigma=number("sigma", sigma),
        speed_factor=_speed_factor(xml, element, deviation),
        probability=weight(xml, element),
        parameters=parameters(xml, element, report),
        line=element.sourceline,
    )


def _speed_factor(xml: XmlReader, element: Element, deviation: float) -> SpeedFactor:
    text = xml.text(element, "speedFactor", "1").strip()
    deviation = xml.number(element, "speedDev", deviation, minimum=0.0)
    given = re.fullmatch(r"(norm|normc)\(([^()]*)\)", text)
    if given is None:
        return SpeedFactor(mean=xml.parse_number(element, "speedFactor", text, 0.0), deviation=deviation)
    numbers = [xml.parse_number(element, "speedFactor", part) for part in given[2].split(",")]
    if not 2 <= len(numbers) <= 4 or (given[1] == "norm" and len(numbers) != 2):
        raise xml.error(element, f"speedFactor='{text[:40]}' has {len(numbers)} parameters")
    if numbers[1] < 0:
        raise xml.error(element, f"speedFactor='{text[:40]}' has a negative deviation")
    bounds = [0.2, 2.0] if given[1] == "normc" else [-math.inf, math.inf]
    bounds[: len(numbers) - 2] = numbers[2:]
    if bounds[0] > bounds[1]:
        raise xml.error(element, f"speedFactor='{text[:40]}' has its bounds the wrong way round")
    return SpeedFactor(mean=numbers[0], deviation=numbers[1], minimum=bounds[0], maximum=bounds[1])


def weight(xml: XmlReader, element: Element) -> float:
    """The weight of a member of a distribution."""
    return xml.number(element, "probability", 1.0, minimum=0.0)


def parameters(xml: XmlReader, element: Element, report: ImportReport) -> dict[str, str]:
    """Attributes without a field of their own, and `<param>` children."""
    found = xml.unasked(element)
    for child in element:
        if child.tag == "param":
            found[xml.text(child, "key")] = xml.text(child, "value", "")
            report.read("param")
    return found


def parse_time(xml: XmlReader, element: Element, name: str, value: str) -> float:
    """Seconds, or [days:]hours:minutes:seconds."""
    parts = value.split(":")
    if len(parts) not in (1, 3, 4):
        raise xml.error(element, f"{name}='{value[:40]}' is neither seconds nor h:m:s nor d:h:m:s")
    numbers = [xml.parse_number(element, name, part) for part in parts]
    sign = -1.0 if parts[0].lstrip().startswith("-") else 1.0
    scales = (1.0, 60.0, 3600.0, 86400.0)
    return sign * sum(abs(n) * scale for n, scale in zip(reversed(numbers), scales, strict=False))

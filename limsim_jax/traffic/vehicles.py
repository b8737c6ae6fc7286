"""Vehicles and drivers: classes, sizes, limits, and driving from cautious to aggressive.

A `Population` is a mixture of types. Within a type every parameter has a truncated log-normal
distribution (`speed_factor` and `svo`: normal), and a Gaussian copula joins them: two standard normal
scores per vehicle, aggressiveness and size, correlate with the score of each parameter by its `loading`.
`sample` draws one vehicle from one key, so a vehicle depends on its key alone and not on its batch.

The default values and their sources stand in `DEFAULTS`; `experiments/vehicle_table.py` prints them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.lax import erf, erf_inv
from jaxtyping import Array, Float, Int, Key
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import VEHICLE_CLASSES, LaneMap
from limsim_jax.maps.network import MapError
from limsim_jax.maps.sumo.records import VehicleType
from limsim_jax.types import Driver, Shape
from limsim_jax.xla import computed_once

BODY = ("length", "width", "wheelbase")
PARAMETERS = (*(field.name for field in fields(Driver)), *BODY)
"""Names of the columns `P` of a `Population`."""

CUT = 2.5
"""Standard deviations from the median at which the default distributions end."""

NORMAL = ("speed_factor", "svo")
"""Parameters with a normal instead of a log-normal distribution."""

_IS_NORMAL = np.array([name in NORMAL for name in PARAMETERS])
_LATENT = np.array([int(name in BODY) for name in PARAMETERS])  # 0 aggressiveness, 1 size


@struct.dataclass(frozen=True, kw_only=True)
class Population:
    """Types `Y` of vehicles, and the distributions of their `PARAMETERS` `P`."""

    vehicle_class: Int[Array, " Y"]  # index into maps.lane_map.VEHICLE_CLASSES
    share: Float[Array, " Y"]  # of the vehicles that enter; weights, need not sum to 1
    median: Float[Array, "Y P"]  # before truncation
    spread: Float[Array, "Y P"]  # standard deviation of the logarithm, or of the value if `NORMAL`
    loading: Float[Array, "Y P"]  # -1..1, correlation with aggressiveness (of bodies: size)
    lower: Float[Array, "Y P"]
    upper: Float[Array, "Y P"]
    factor: Float[Array, "Y P P"] | None = None
    """Lower triangular root of the correlation of what `loading` leaves of the scores; None: of no
    correlation."""


def sample(
    population: Population, key: Key[Array, ""], vehicle_type: Int[Array, ""] | None = None
) -> tuple[Driver, Shape]:
    """One vehicle and its driver, every leaf of shape `[]`.

    Args:
      population: from which the vehicle is drawn.
      key: of this vehicle alone; is consumed.
      vehicle_type: row of the population; drawn by `share` if not given.
    """
    # One call of the generator: each costs compilation time.
    return _vehicle(population, jax.random.normal(key, (3 + len(PARAMETERS),)), vehicle_type)


def vehicles_of(
    population: Population, draws: Float[Array, "N P"], vehicle_type: Int[Array, " N"]
) -> tuple[Driver, Shape]:
    """Vehicles of given types from standard normals; every leaf of shape `[N]`."""
    return jax.vmap(lambda x, y: _vehicle(population, x, y))(draws, vehicle_type)


def _vehicle(
    population: Population, draws: Float[Array, " P"], vehicle_type: Int[Array, ""] | None
) -> tuple[Driver, Shape]:
    chance, latent, own = draws[0], draws[1:3], draws[3:]
    if vehicle_type is None:
        total = jnp.cumsum(population.share)
        threshold = _probability(chance) * total[-1]
        # Some vehicle of the last type that has a share, should rounding take `threshold` to the end.
        vehicle_type = jnp.argmax((threshold < total) | (total == total[-1])).astype(jnp.int32)
    median, spread, loading, lower, upper = (
        leaf[vehicle_type]
        for leaf in (
            population.median,
            population.spread,
            population.loading,
            population.lower,
            population.upper,
        )
    )
    if population.factor is not None:
        own = population.factor[vehicle_type] @ own
    score = loading * latent[_LATENT] + jnp.sqrt(1 - loading * loading) * own

    def scale(x: Array) -> Array:
        return jnp.where(_IS_NORMAL, x, jnp.log(jnp.maximum(x, 1e-30)))

    # Truncation by the inverse distribution function: no redrawing, and no heap at the bounds.
    width = jnp.where(spread > 0, spread, 1)
    low, high = (_probability((scale(x) - scale(median)) / width) for x in (lower, upper))
    quantile = low + (high - low) * _probability(score)
    deviate = math.sqrt(2) * erf_inv(jnp.clip(2 * quantile - 1, -1 + 1e-6, 1 - 1e-6))  # within 4.9
    x = scale(median) + spread * deviate
    x = jnp.clip(jnp.where(_IS_NORMAL, x, jnp.exp(x)), lower, upper)
    values = dict(zip(PARAMETERS, computed_once(x), strict=True))
    body = {name: values.pop(name) for name in BODY}
    return Driver(**values), Shape(**body, vehicle_class=population.vehicle_class[vehicle_type])


def sample_vehicles(
    population: Population,
    key: Key[Array, ""],
    vehicle: Int[Array, " N"],
    vehicle_type: Int[Array, " N"] | None = None,
) -> tuple[Driver, Shape]:
    """Vehicles by number, every leaf of shape `[N]`; equal numbers give equal vehicles.

    Args:
      population: from which the vehicle is drawn.
      key: of the world; vehicle i uses `fold_in(key, i)`.
      vehicle: numbers, in any order.
      vehicle_type: rows of the population; drawn by `share` if not given.
    """
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(vehicle)
    if vehicle_type is None:
        return jax.vmap(lambda k: sample(population, k))(keys)
    return jax.vmap(lambda k, y: sample(population, k, y))(keys, vehicle_type)


def _probability(score: Array) -> Array:
    """Distribution function of the standard normal distribution."""
    return 0.5 * (1 + erf(score / math.sqrt(2)))


# ---- populations


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """Default distribution of a parameter; tuples have one value per class of `VEHICLE_CLASSES`."""

    meaning: str
    unit: str
    median: tuple[float, ...]
    spread: float | tuple[float, ...] = 0.0
    loading: float = 0.0
    bounds: tuple[float, float] = (0.0, math.inf)  # on top of `CUT`
    vtype: str = ""  # attribute of a SUMO vType that sets it
    source: str


_ALL = len(VEHICLE_CLASSES)
_ACC = "Kesting, Treiber, Helbing (2010)"
_MOBIL = "Kesting, Treiber, Helbing (2007)"
_FGSV = "FGSV design vehicles (2001), which are 85th percentiles"

# Where a source has one number, or one for cars and one for trucks, the other classes and all spreads and
# loadings are choices of this project.
DEFAULTS: dict[str, Parameter] = {
    "speed_factor": Parameter(
        meaning="desired speed over the speed limit",
        unit="1",
        median=(1.0,) * _ALL,
        spread=(0.1, 0.05, 0.05, 0.05, 0.1, 0.1),
        loading=0.6,
        vtype="speedFactor, speedDev",
        source="SUMO defaults (speedDev)",
    ),
    "v_max": Parameter(
        meaning="speed never exceeded",
        unit="m/s",
        median=(50.0, 38.9, 25.0, 27.8, 50.0, 44.4),
        spread=(0.1, 0.05, 0.01, 0.01, 0.1, 0.05),
        loading=0.3,
        vtype="maxSpeed",
        source="trucks 90 km/h, buses 100 km/h: Directive 92/6/EEC as amended by 2002/85/EC",
    ),
    "T": Parameter(
        meaning="time gap",
        unit="s",
        median=(1.0, 1.0, 1.35, 1.35, 0.9, 0.9),
        spread=0.25,
        loading=-0.7,
        bounds=(0.6, 3.0),
        vtype="tau",
        source="Treiber, Kesting (2013), Tab. 11.2: 1.0; trucks 4/3 of cars",
    ),
    "s0": Parameter(
        meaning="standstill gap",
        unit="m",
        median=(2.0, 2.0, 3.0, 3.0, 1.5, 2.0),
        spread=0.2,
        loading=-0.5,
        bounds=(1.0, 5.0),
        vtype="minGap",
        source=f"{_ACC}: cars 2, trucks 4",
    ),
    "a": Parameter(
        meaning="largest acceleration",
        unit="m/s^2",
        median=(1.9, 1.7, 1.0, 1.2, 2.8, 2.2),
        spread=0.2,
        loading=0.6,
        vtype="accel",
        source=f"between {_ACC}, 1.4 and 0.7, and SUMO, 2.6 and 1.3: saturation flow of HCM 6, ch. 19",
    ),
    "b": Parameter(
        meaning="comfortable deceleration",
        unit="m/s^2",
        median=(2.0, 2.0, 2.0, 1.5, 2.5, 2.5),
        spread=0.2,
        loading=0.6,
        bounds=(0.8, 4.0),
        vtype="decel",
        source=f"{_ACC}: 2",
    ),
    "delta": Parameter(
        meaning="acceleration exponent",
        unit="1",
        median=(4.0,) * _ALL,
        vtype="delta",
        source="Treiber, Hennecke, Helbing (2000)",
    ),
    "b_max": Parameter(
        meaning="hardest braking, dry road",
        unit="m/s^2",
        median=(8.5, 8.0, 6.5, 6.5, 8.5, 8.5),
        spread=0.03,
        bounds=(0.0, 9.0),
        vtype="emergencyDecel",
        source="below the SUMO defaults (emergencyDecel): cars 9, trucks and buses 7, motorcycles 10",
    ),
    "coolness": Parameter(
        meaning="trust that the leader does not brake hard",
        unit="1",
        median=(0.99,) * _ALL,
        bounds=(0.0, 1.0),
        source=_ACC,
    ),
    "politeness": Parameter(
        meaning="MOBIL p, weight of others' accelerations",
        unit="1",
        median=(0.4, 0.4, 0.4, 0.4, 0.4, 0.2),
        spread=0.5,
        loading=-0.6,
        bounds=(0.0, 1.0),
        source=f"{_MOBIL}: 0 to 1",
    ),
    "threshold": Parameter(
        meaning="MOBIL a_th, least advantage of a lane change",
        unit="m/s^2",
        median=(0.4,) * _ALL,
        spread=0.3,
        loading=-0.3,
        source=f"above the 0.1 of {_MOBIL}, for the lane changes of Knoop et al. (2012), TRR: 0.5 per km",
    ),
    "b_safe": Parameter(
        meaning="braking that a lane change may ask of the follower",
        unit="m/s^2",
        median=(3.0,) * _ALL,
        spread=0.15,
        loading=0.5,
        bounds=(1.5, 6.0),
        source=f"below the 4 of {_MOBIL}",
    ),
    "keep_right": Parameter(
        meaning="MOBIL bias towards the outer lane, where the map asks for it",
        unit="m/s^2",
        median=(0.15,) * _ALL,
        source=f"half of the 0.3 of {_MOBIL}: the left lane carries most at high flows",
    ),
    "lane_change_time": Parameter(
        meaning="duration of a lane change",
        unit="s",
        median=(4.5, 4.5, 5.5, 5.5, 3.5, 4.0),
        spread=0.18,
        loading=-0.4,
        bounds=(3.0, 7.0),
        source="below the mean of 5 to 6 s that Toledo, Zohar (2007), TRR 1999, report",
    ),
    "a_lat": Parameter(
        meaning="lateral acceleration accepted in bends",
        unit="m/s^2",
        median=(3.2, 3.0, 2.3, 1.9, 3.5, 3.5),
        spread=0.15,
        loading=0.5,
        source="NCHRP Report 672 (2010), ch. 6: 25 km/h at a radius of 16 m; SUMO limits turns at 5.5",
    ),
    "gap_factor": Parameter(
        meaning="factor on the gaps accepted at junctions",
        unit="1",
        median=(1.0, 1.0, 1.2, 1.2, 1.0, 0.9),
        spread=0.2,
        loading=-0.6,
        bounds=(0.6, 1.8),
        source="heavy vehicles: HCM (2010), 1 s more than cars on a critical headway of 4 to 7 s",
    ),
    "svo": Parameter(
        meaning="social value orientation",
        unit="rad",
        median=(0.39,) * _ALL,
        spread=0.2,
        loading=-0.6,
        bounds=(-0.21, 1.0),
        source="Murphy, Ackermann, Handgraaf (2011): 22.45 degrees part individualists from prosocials",
    ),
    "length": Parameter(
        meaning="length",
        unit="m",
        median=(4.5, 6.0, 8.5, 12.0, 2.2, 6.0),
        spread=(0.05, 0.13, 0.1, 0.03, 0.04, 0.1),
        loading=0.95,
        bounds=(0.0, 13.5),
        vtype="length",
        source=f"{_FGSV}: 4.74, 6.89, 9.46; buses 12.0; motorcycles: SUMO defaults",
    ),
    "width": Parameter(
        meaning="width without mirrors",
        unit="m",
        median=(1.8, 2.05, 2.5, 2.5, 0.9, 2.1),
        spread=(0.03, 0.03, 0.01, 0.01, 0.04, 0.03),
        loading=0.8,
        bounds=(0.0, 2.55),
        vtype="width",
        source="SUMO defaults (vans 2.16, trucks 2.4); at most 2.55: Directive 96/53/EC",
    ),
    "wheelbase": Parameter(
        meaning="front to rear axle",
        unit="m",
        median=(2.6, 3.45, 4.7, 5.8, 1.45, 3.45),
        spread=(0.05, 0.13, 0.1, 0.03, 0.04, 0.1),
        loading=0.95,
        vtype="length",
        source="ratio to the length: FGSV design vehicles, 2.70, 3.95, 5.20, 5.80 m",
    ),
}

URBAN = {"car": 0.82, "van": 0.09, "truck": 0.03, "bus": 0.02, "motorcycle": 0.035, "emergency": 0.005}
"""Shares of the classes in towns: a choice of this project."""

HIGHWAY = {"car": 0.78, "van": 0.08, "truck": 0.12, "bus": 0.01, "motorcycle": 0.009, "emergency": 0.001}
"""Shares of the classes on highways: a choice of this project."""


def default_population(shares: Mapping[str, float] = URBAN) -> Population:
    """One type per class, in the order of `VEHICLE_CLASSES`, distributed by `DEFAULTS`.

    Args:
      shares: weight per class; classes that are left out do not occur.

    Raises:
      ValueError: a class is unknown, a share negative, or none positive.
    """
    _check_known("vehicle class", shares, VEHICLE_CLASSES)
    return _population([(name, shares.get(name, 0.0), _default_rows(name)) for name in VEHICLE_CLASSES])


def uniform_population(vehicle_class: str = "car", **parameters: float) -> Population:
    """A population of equal vehicles: the medians of a class, with what `parameters` say instead.

    Raises:
      ValueError: the class or a parameter is unknown.
    """
    _check_known("vehicle class", [vehicle_class], VEHICLE_CLASSES)
    _check_known("parameter", parameters, PARAMETERS)
    rows = {name: _fixed(row.median) for name, row in _default_rows(vehicle_class).items()}
    rows |= {name: _fixed(value) for name, value in parameters.items()}
    return _population([(vehicle_class, 1.0, rows)])


SWEEP = 0.6
"""m that a body may stand out of its path in the tightest bend of a map, see `restrict_to_map`."""


RARE_BENDS = 50
"""Number of lanes of which one does not count in `restrict_to_map`."""

CAR = 5.0
"""m, length up to which a vehicle fits everywhere."""

SIDE_ROOM = 0.2
"""m, by which a lane has to be wider than a vehicle on it."""


def restrict_to_map(population: Population, lane_map: LaneMap) -> Population:
    """Leave out vehicle types too long or too wide for a map.

    In a bend of curvature kappa the ends of a body of length l stand out by kappa l^2 / 8. On most urban
    junctions that leaves trucks and buses no room beside traffic in the next lane, so they get no share.
    One lane in `RARE_BENDS` may be tighter, or narrower than a vehicle. Cars drive everywhere.

    Raises:
      ValueError: none fits.
    """
    bends = np.asarray(lane_map.curvature_max)[np.asarray(lane_map.valid)]
    bend = float(np.quantile(bends, 1 - 1 / RARE_BENDS, method="lower"))
    length, wide = (np.asarray(population.median)[:, PARAMETERS.index(x)] for x in ("length", "width"))
    fits = (bend * length * length / 8 <= SWEEP) | (length <= CAR)
    rows, begin, count = (np.asarray(x) for x in (lane_map.rows, lane_map.first, lane_map.count))
    middle = (begin + count // 2)[np.asarray(lane_map.valid)]
    narrow = float(np.quantile(rows[middle, 8], 1 / RARE_BENDS, method="higher"))
    fits &= (wide + SIDE_ROOM <= narrow) | (length <= CAR)
    share = np.where(fits, np.asarray(population.share), 0)
    if not share.any():
        raise ValueError(
            f"no vehicle of the population fits into bends of {1 / max(bend, 1e-9):.1f} m radius "
            f"and lanes of {narrow:.2f} m"
        )
    return replace(population, share=jnp.asarray(share, jnp.float32))


def refit(
    population: Population,
    classes: Sequence[str],
    rows: Mapping[str, tuple[float, float, float, float]],
    factor: NDArray[np.float64],
) -> Population:
    """Replace the joint distribution of some parameters, see `population_file`.

    Args:
      population: one type per class.
      classes: of the types that change.
      rows: median, spread, lower and upper bound per parameter.
      factor: lower triangular root of the correlation of their scores, in the order of `rows`.
    """
    types = np.isin(np.asarray(population.vehicle_class), [VEHICLE_CLASSES.index(name) for name in classes])
    at = np.array([PARAMETERS.index(name) for name in rows])
    values = np.asarray(list(rows.values()))
    leaves = {
        name: np.array(getattr(population, name))
        for name in ("median", "spread", "lower", "upper", "loading")
    }
    for k, name in enumerate(("median", "spread", "lower", "upper")):
        leaves[name][np.ix_(types, at)] = values[:, k]
    leaves["loading"][np.ix_(types, at)] = 0
    size = len(PARAMETERS)
    roots = np.tile(np.eye(size), (len(types), 1, 1))
    # In the order of the columns, so that the root stays lower triangular.
    correlation = np.eye(size)
    correlation[np.ix_(at, at)] = factor @ factor.T
    roots[types] = np.linalg.cholesky(correlation)
    leaves["factor"] = roots
    return replace(population, **{name: jnp.asarray(leaf, jnp.float32) for name, leaf in leaves.items()})


def from_vtypes(types: Sequence[VehicleType]) -> Population:
    """SUMO's vehicle types as a population, in the given order.

    Shares are their probabilities. What a vType gives is the same for all its vehicles, except the speed
    factor, which is drawn. `tau`, `minGap`, `accel`, `decel`, `emergencyDecel`, `maxSpeed` become T, s0, a,
    b, b_max, v_max whatever the car-following model. `sigma` is ignored, because these models have no such
    imperfection. The wheelbase scales with the length. Lane changes, bends and gaps at junctions are
    distributed as `DEFAULTS` say for the class.

    Raises:
      MapError: there are no types, one is of no motor vehicle, or no probability is positive.
    """
    members = []
    for vtype in types:
        if vtype.engine_class is None:
            raise MapError(
                f"vClass '{vtype.vehicle_class}' is no motor traffic on roads; leave the type out",
                line=vtype.line,
                element=f"vType {vtype.id}",
            )
        rows = _default_rows(vtype.engine_class)
        given = {
            "v_max": vtype.max_speed,
            "T": vtype.tau,
            "s0": vtype.min_gap,
            "a": vtype.accel,
            "b": vtype.decel,
            "b_max": max(vtype.emergency_decel, vtype.decel),
            "length": vtype.length,
            "width": vtype.width,
            "wheelbase": vtype.length * rows["wheelbase"].median / rows["length"].median,
        }
        if "delta" in vtype.parameters:
            given["delta"] = _number(vtype, "delta")
        rows |= {name: _fixed(value) for name, value in given.items()}
        factor = vtype.speed_factor
        rows["speed_factor"] = (
            _Row(factor.mean, factor.deviation, rows["speed_factor"].loading, factor.minimum, factor.maximum)
            if factor.deviation > 0
            else _fixed(factor.mean)
        )
        members.append((vtype.engine_class, vtype.probability, rows))
    if not any(share > 0 for _, share, _ in members):
        raise MapError("no vehicle type with a positive probability", element="vType")
    return _population(members)


@dataclass(frozen=True)
class _Row:
    """Distribution of one parameter of one type: an entry of every array of a `Population`."""

    median: float
    spread: float
    loading: float
    lower: float
    upper: float


def _fixed(value: float) -> _Row:
    return _Row(value, 0.0, 0.0, value, value)


def _default_rows(vehicle_class: str) -> dict[str, _Row]:
    column = VEHICLE_CLASSES.index(vehicle_class)
    rows = {}
    for name, parameter in DEFAULTS.items():
        median = parameter.median[column]
        spread = parameter.spread[column] if isinstance(parameter.spread, tuple) else parameter.spread
        if spread == 0:
            rows[name] = _fixed(median)
            continue
        if name in NORMAL:
            low, high = median - CUT * spread, median + CUT * spread
        else:
            low, high = median * math.exp(-CUT * spread), median * math.exp(CUT * spread)
        least, most = parameter.bounds
        rows[name] = _Row(median, spread, parameter.loading, max(low, least), min(high, most))
    return rows


def _check_known(kind: str, names: Iterable[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise ValueError(f"{kind} '{name}' is unknown; known are {', '.join(known)}")


def _number(vtype: VehicleType, attribute: str) -> float:
    text = vtype.parameters[attribute]
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        message = f"{attribute}='{text[:40]}' is no positive number"
        raise MapError(message, line=vtype.line, element=f"vType {vtype.id}")
    return value


def _population(members: Sequence[tuple[str, float, Mapping[str, _Row]]]) -> Population:
    classes, shares, rows = zip(*members, strict=True)
    if not all(0 <= share < math.inf for share in shares) or sum(shares) <= 0:
        raise ValueError(f"shares have to be 0 or more, and one of them positive: {list(shares)}")

    def table(name: str) -> Array:
        return jnp.array([[getattr(row[p], name) for p in PARAMETERS] for row in rows], jnp.float32)

    return Population(
        vehicle_class=jnp.array([VEHICLE_CLASSES.index(name) for name in classes], jnp.int32),
        share=jnp.array(shares, jnp.float32),
        **{field.name: table(field.name) for field in fields(_Row)},
    )


__all__ = [
    "BODY",
    "CUT",
    "DEFAULTS",
    "HIGHWAY",
    "NORMAL",
    "PARAMETERS",
    "URBAN",
    "Parameter",
    "Population",
    "default_population",
    "from_vtypes",
    "refit",
    "sample",
    "sample_vehicles",
    "uniform_population",
    "vehicles_of",
]

"""The random numbers of a world: drawn from a key, or given as one array.

`draw` makes them from a key, by place and number. A `Layout` lists those that a world can depend on, as one
array of independent standard normals `[D]`: arrivals, places at the start, goals, types, bodies and drivers.
Another array is another world, without another program.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int, Key
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import NO_LANE
from limsim_jax.traffic.demand.arrays import FLOW_BITS, NEVER, Demand
from limsim_jax.traffic.vehicles import PARAMETERS

# Purposes of keys.
_ARRIVALS, _SEATS, _ROLES, _VEHICLES = range(4)

_LATENT = 3
"""Numbers of a vehicle before those of its parameters: its type, and what parameters have in common."""

Kind = Literal["uniform", "gumbel", "normal"]


@struct.dataclass(frozen=True, kw_only=True)
class Draws:
    """Random numbers of a world; `K` streams, `A` arrivals, `S` seats, `R` rows of the schedule and seats."""

    arrivals: Float[Array, "K A"]  # uniform
    order: Float[Array, " S"]  # Gumbel: which seats are taken
    place: Float[Array, " S"]  # uniform: where in its seat
    roles: Float[Array, "R 2"]  # uniform: goal and type
    vehicles: Float[Array, "R P"]  # normal: body and driver


def draw(demand: Demand, key: Key[Array, ""]) -> Draws:
    """Random numbers from a key. Those of vehicle k of a queue do not depend on other flows."""
    seats = demand.seat_lane.shape[0]
    number = jnp.concatenate([_row_numbers(demand), -1 - jnp.arange(seats, dtype=jnp.int32)])
    seat_key = jax.random.fold_in(key, _SEATS)
    roles, vehicles = (jax.random.fold_in(key, purpose) for purpose in (_ROLES, _VEHICLES))
    each = jax.vmap(jax.random.fold_in, (None, 0))
    return Draws(
        arrivals=draw_arrivals(demand, key),
        order=jax.random.gumbel(jax.random.fold_in(seat_key, 0), (seats,)),
        place=jax.random.uniform(jax.random.fold_in(seat_key, 1), (seats,)),
        roles=jax.vmap(lambda k: jax.random.uniform(k, (2,)))(each(roles, number)),
        vehicles=jax.vmap(lambda k: jax.random.normal(k, (_LATENT + len(PARAMETERS),)))(
            each(vehicles, number)
        ),
    )


def draw_arrivals(demand: Demand, key: Key[Array, ""]) -> Float[Array, "K A"]:
    """Those of the arrivals."""
    key = jax.random.fold_in(key, _ARRIVALS)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, demand.stream)
    return jax.vmap(lambda k: jax.random.uniform(k, (demand.arrivals + 1,)))(keys)


def queue_lanes(demand: Demand) -> tuple[Int[Array, " V"], Int[Array, " V"]]:
    """Lane and place in its queue of every row of the schedule."""
    origin = jnp.sort(demand.row_origin)
    lane = demand.lane.at[origin].get(mode="fill", fill_value=NO_LANE)
    return lane, jnp.arange(origin.shape[0], dtype=jnp.int32) - demand.start[origin]


def _row_numbers(demand: Demand) -> Int[Array, " V"]:
    lane, place = queue_lanes(demand)
    return (lane << FLOW_BITS) + place


class Number(NamedTuple):
    """What a number of a world means."""

    what: str  # "gap", "goal", "type", "seat", "place", or a parameter of body or driver
    vehicle: int  # row of `Draws.vehicles`; -1: of none
    stream: int  # of an arrival; -1: of none
    lane: int  # row of the lane map on which it comes in or starts
    place: int  # in its queue, from 0


@dataclass(frozen=True)
class Layout:
    """The numbers of a world that can matter, as one array `[D]`.

    Attributes:
      numbers: what each of them means.
      kinds: distribution of each, as `Draws` has it.
      shapes: of the fields of `Draws`.
    """

    numbers: tuple[Number, ...]
    kinds: NDArray[np.str_]
    shapes: dict[str, tuple[int, ...]]
    _at: dict[str, tuple[NDArray[np.int64], NDArray[np.int64]]] = field(repr=False)  # into field, into array

    @classmethod
    def of(cls, demand: Demand) -> Layout:
        """Those of a demand, on the host."""
        host: Any = jax.tree.map(np.asarray, demand)
        rows, seats = len(host.row_origin), len(host.seat_lane)
        width = _LATENT + len(PARAMETERS)
        shapes = {
            "arrivals": (len(host.stream), demand.arrivals + 1),
            "order": (seats,),
            "place": (seats,),
            "roles": (rows + seats, 2),
            "vehicles": (rows + seats, width),
        }
        lane, place = (np.asarray(x) for x in queue_lanes(demand))
        lane = np.concatenate([lane, host.seat_lane])
        place = np.concatenate([place, np.zeros(seats, int)])
        possible = (host.seat_lane != NO_LANE) & np.isfinite(host.seat_weight)  # others pad the table
        open_seats = np.flatnonzero(possible & (demand.initial > 0))
        vehicles = np.concatenate([np.flatnonzero(lane[:rows] != NO_LANE), rows + open_seats])
        spread = np.asarray(host.population.spread)[np.asarray(host.population.share) > 0]
        columns = [_LATENT + k for k in np.flatnonzero((spread > 0).any(0))]
        columns = [1, 2, *columns] if columns else []
        streams = np.flatnonzero(host.begin < NEVER)
        pairs = zip(host.row_stream.tolist(), host.row_origin.tolist(), strict=True)
        origin = {k: o for k, o in pairs if o < len(host.lane)}  # others are padding
        of_stream = {int(k): int(host.lane[origin[int(k)]]) for k in streams if int(k) in origin}
        found: list[tuple[str, int, Kind, Number]] = []
        for k, at_lane in of_stream.items():
            for j in range(int(host.capacity[k]) + 1):
                where = k * shapes["arrivals"][1] + j
                found.append(("arrivals", where, "uniform", Number("gap", -1, k, at_lane, j)))
        for seat in open_seats:
            at = int(rows + seat), -1, int(host.seat_lane[seat]), 0
            found.append(("order", int(seat), "gumbel", Number("seat", *at)))
            found.append(("place", int(seat), "uniform", Number("place", *at)))
        for row in vehicles:
            at = int(row), -1, int(lane[row]), int(place[row])
            for j, what in enumerate(("goal", "type")):
                found.append(("roles", 2 * int(row) + j, "uniform", Number(what, *at)))
            for j in columns:
                what = ("aggressiveness", "size")[j - 1] if j < _LATENT else PARAMETERS[j - _LATENT]
                found.append(("vehicles", width * int(row) + j, "normal", Number(what, *at)))
        fields = np.array([x[0] for x in found])
        within = np.array([x[1] for x in found], np.int64)
        at_fields = {name: (within[fields == name], np.flatnonzero(fields == name)) for name in shapes}
        return cls(tuple(x[3] for x in found), np.array([x[2] for x in found]), shapes, at_fields)

    @property
    def size(self) -> int:
        """How many there are, `D`."""
        return len(self.numbers)

    @property
    def rows(self) -> int:
        """Vehicles of the schedule; those in seats have higher numbers."""
        return self.shapes["roles"][0] - self.shapes["order"][0]

    def draws(self, values: Float[Array, " D"]) -> Draws:
        """Values as the random numbers of a world; all others are in the middle. Traced."""
        middle = {"arrivals": 0.5, "place": 0.5, "roles": 0.5}
        found = {}
        for name, shape in self.shapes.items():
            flat = jnp.full(int(np.prod(shape)), middle.get(name, 0.0), jnp.float32)
            into, out_of = self._at[name]
            found[name] = flat.at[into].set(values[out_of]).reshape(shape)
        return Draws(**found)

    def values(self, draws: Draws) -> Float[Array, " D"]:
        """The array of some draws: the inverse of `draws`. Traced."""
        found = jnp.zeros(self.size, jnp.float32)
        for name in self.shapes:
            into, out_of = self._at[name]
            found = found.at[out_of].set(getattr(draws, name).reshape(-1)[into])
        return found

    def from_normals(self, z: NDArray[Any]) -> NDArray[np.float32]:
        """Values `[..., D]` of standard normals: each by its inverse distribution function."""
        from scipy.special import log_ndtr, ndtr

        x = np.asarray(z, np.float64)
        values = x.copy()
        uniform, gumbel = self.kinds == "uniform", self.kinds == "gumbel"
        values[..., uniform] = np.clip(ndtr(x[..., uniform]), 0, 1 - 2.0**-24)  # within [0, 1) as float32
        values[..., gumbel] = -np.log(-log_ndtr(x[..., gumbel]))
        return values.astype(np.float32)

    def to_normals(self, values: NDArray[Any]) -> NDArray[np.float64]:
        """The inverse of `from_normals`; what has no finite normal gets one of 8."""
        from scipy.special import ndtri

        x = np.asarray(values, np.float64)
        z = x.copy()
        uniform, gumbel = self.kinds == "uniform", self.kinds == "gumbel"
        z[..., uniform] = ndtri(x[..., uniform])
        z[..., gumbel] = ndtri(np.exp(-np.exp(-x[..., gumbel])))
        return np.clip(z, -8, 8)


__all__ = ["Draws", "Layout", "Number", "draw", "draw_arrivals", "queue_lanes"]

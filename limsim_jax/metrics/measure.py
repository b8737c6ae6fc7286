"""Base classes: `Metric` for metrics of your own, `Measure` for built-in ones.

    class SlowTime(lj.Metric):
        name, unit, better = "slow_time", "s below 2 m/s", "lower"

        def init(self, slots):
            return jnp.float32(0)

        def update(self, carry, step):
            return carry + jnp.where(step.v < 2, step.dt, 0)

        def result(self, carry):
            return carry

A metric is written for one ego in one world. `vmap` and `scan` make many of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.metrics.blame import ContactCarry
from limsim_jax.metrics.description import Better, Description
from limsim_jax.metrics.motion import Filtered, MotionCarry
from limsim_jax.metrics.reductions import Measured, measured
from limsim_jax.metrics.step import StepView


class Metric:
    """Base class of a metric of one's own: a column of the results.

    Attributes:
      name: of the column.
      unit: unit and meaning, as "s below 2 m/s"; a share of episodes begins with "1 if".
      better: which values are better: "higher", "lower" or "neither".
      formula, source, missing: more of the description, optional.
    """

    name: str
    unit: str
    better: Better = "neither"
    formula: str = ""
    source: str = ""
    missing: str = ""

    def init(self, slots: int) -> Any:
        """The memory before the first step: a pytree of arrays, for a world of `slots` vehicles."""
        raise NotImplementedError

    def update(self, carry: Any, step: StepView) -> Any:
        """The memory after a physics step of the ego.

        It keeps its shapes and types. Called from the first step that the ego drives until it arrives or
        leaves.
        """
        raise NotImplementedError

    def result(self, carry: Any) -> Any:
        """The value at the end: a scalar, or a scalar `Measured`.

        A value that is not finite is missing.
        """
        raise NotImplementedError

    @property
    def description(self) -> Description:
        """What the column is, for tables and reports. Its meaning tells which values are better."""
        direction = "" if self.better == "neither" else f"; {self.better} is better"
        return Description(
            self.name,
            self.unit + direction,
            "Own metrics",
            self.better,
            "proportion" if self.unit.startswith("1 if") else "mean",
            self.formula,
            self.source,
            self.missing,
        )


class Derived(NamedTuple):
    """Findings of a step that several measures build on."""

    contacts: ContactCarry  # after this step
    hit: Bool[Array, ""]  # a new contact in this step
    motion: MotionCarry  # after this step
    filtered: Filtered


class Summary(NamedTuple):
    """An episode at its end, for measures of the whole."""

    started: Bool[Array, ""]  # the ego was on the road
    arrived: Bool[Array, ""]
    there: Bool[Array, ""]  # it is still on the road
    broken: Bool[Array, ""]  # its policy has failed
    failed: Bool[Array, ""]  # that, or a contact, or it left the road
    now: Float[Array, ""]  # s, time of its last step
    duration: Float[Array, ""]  # s
    driven: Bool[Array, ""]  # it lasted at least a step
    judged: Bool[Array, ""]  # that, or the ego failed at its start: scores have a value
    progress: Float[Array, ""]  # m nearer to the goal
    route: Float[Array, ""]  # m from the start to the goal
    completion: Float[Array, ""]  # 0 to 1
    distance: Float[Array, ""]  # m driven
    off_route: Float[Array, ""]  # m driven off the road or the route
    against_flow: Float[Array, ""]  # m within a second, at most
    overspeed: Float[Array, ""]  # m, integral of the speed above the limit
    contacts: Int[Array, ""]
    faults: Int[Array, ""]  # of them at the ego's fault by nuPlan's rules
    off_road: Bool[Array, ""]  # at some time
    red_lights: Int[Array, ""]
    stop_signs: Int[Array, ""]
    comfort: dict[str, Measured]  # the columns of `Comfort`
    rest: Filtered  # filtered values that the end of the record leaves
    reference_progress: Float[Array, ""] | None  # m, of nuPlan's expert, where it is given

    def number(self, x: Array) -> Measured:
        """A count or a flag as a measured number."""
        return measured(x.astype(self.duration.dtype), self.started)


class Measure:
    """Built-in metrics with a common memory. `columns` describes each of them, in the order of results."""

    name: ClassVar[str]
    columns: ClassVar[tuple[Description, ...]]

    def init(self, slots: int, zones: int) -> Any:
        """The memory before the first step; the numbers are those of slots and conflict zones."""
        return ()

    def update(self, carry: Any, step: StepView, derived: Derived) -> Any:
        """The memory after a step."""
        return carry

    def result(self, carry: Any, summary: Summary) -> dict[str, Measured]:
        """The values of all `columns`."""
        raise NotImplementedError


@dataclass(frozen=True)
class Own(Measure):
    """A `Metric` among the built-in measures."""

    metric: Metric

    def init(self, slots: int, zones: int) -> Any:
        """The memory of the metric, as arrays of fixed types."""
        return jax.tree.map(_array, self.metric.init(slots))

    def update(self, carry: Any, step: StepView, derived: Derived) -> Any:
        """The memory after a step; the record of the start does not count."""
        new = jax.tree.map(_array, self.metric.update(carry, step))
        return jax.tree.map(lambda x, y: jnp.where(step.drove, x, y), new, carry)

    def result(self, carry: Any, summary: Summary) -> dict[str, Measured]:
        """The value.

        Missing where the metric says so, where it is not finite, or if the ego drove no step.
        """
        found = self.metric.result(carry)
        value, valid = found if isinstance(found, Measured) else (found, True)
        value = jnp.asarray(value).astype(summary.duration.dtype)
        return {self.metric.name: measured(value, valid & jnp.isfinite(value) & summary.driven)}

    def check(self, step: StepView) -> None:
        """Trace the metric once, on a step of its world.

        Raises:
          ValueError: a memory that changes its shape or type, or a result that is no scalar; one line.
        """
        name, metric = self.metric.name, self.metric
        before = jax.eval_shape(lambda: self.init(step.record.active.shape[0], 0))
        after = jax.eval_shape(lambda carry: jax.tree.map(_array, metric.update(carry, step)), before)
        if _types(before) != _types(after):
            raise ValueError(
                f"metric '{name}': update returns {_types(after)}, but init {_types(before)}; "
                "the memory keeps its structure, shapes and types"
            )
        jax.eval_shape(self._scalar, before)

    def _scalar(self, carry: Any) -> tuple[Array, ...]:
        found = self.metric.result(carry)
        for part in found if isinstance(found, Measured) else [found]:
            array = isinstance(part, jax.Array | np.ndarray | np.generic)
            if part.shape != () if array else not isinstance(part, int | float):
                raise ValueError(
                    f"metric '{self.metric.name}': result is {_types(part)}; a scalar is expected"
                )
        return ()


def _array(x: Any) -> Array:
    """An array of a fixed type: Python numbers would take that of their neighbours."""
    x = jnp.asarray(x)
    return jax.lax.convert_element_type(x, x.dtype)


def _types(tree: Any) -> str:
    """Shapes and types of a pytree in words."""
    words = jax.tree.map(lambda x: f"{x.dtype}{list(x.shape)}" if hasattr(x, "dtype") else repr(x), tree)
    return str(words).replace("'", "")


def check_names(metrics: Sequence[Metric], taken: Iterable[str]) -> None:
    """Check names and descriptions of own metrics.

    Raises:
      ValueError: what is no metric, a name that is no identifier or is taken, a missing unit; one line.
    """
    taken = set(taken)
    for metric in metrics:
        kind = type(metric).__name__
        if not isinstance(metric, Metric):
            hint = f"; pass an instance, as {metric.__name__}()" if isinstance(metric, type) else ""
            raise ValueError(f"metrics: {metric!r} is no limsim_jax.Metric{hint}")
        name, unit = getattr(metric, "name", None), getattr(metric, "unit", None)
        if not isinstance(name, str) or not name.isidentifier():
            raise ValueError(f"metric {kind}: name is {name!r}; an identifier is expected, as 'slow_time'")
        if not isinstance(unit, str) or not unit:
            raise ValueError(f"metric '{name}': unit is {unit!r}; text is expected, as 's below 2 m/s'")
        if metric.better not in ("higher", "lower", "neither"):
            raise ValueError(
                f"metric '{name}': better is {metric.better!r}; 'higher', 'lower' or 'neither' is expected"
            )
        if name in taken or name.startswith("traffic_"):
            raise ValueError(f"metric '{name}': another column has this name; choose a new one")
        taken.add(name)

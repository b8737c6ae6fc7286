"""Stand-in until the measures of several egos land."""

from dataclasses import dataclass
from typing import Any

from limsim_jax.metrics.catalog import TOTALS, catalog
from limsim_jax.metrics.observer import EvaluateEgo as _One

_TOTALS = {total.name for total in TOTALS}


@dataclass(frozen=True)
class EvaluateEgo(_One):
    """Metrics of the ego."""

    egos: int = 1
    metrics: tuple[Any, ...] = ()

    @property
    def units(self) -> dict[str, str]:
        """Columns."""
        return {x.name: x.meaning for x in catalog() if x.name not in _TOTALS}


class EvaluateTraffic:
    """Metrics of traffic."""

    units: Any = None

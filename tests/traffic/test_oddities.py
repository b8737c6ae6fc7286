"""What `experiments/oddities.py` counts, on traces made by hand."""

from typing import Any

import numpy as np
import pytest
from oddities import DT, Seen, odd
from traffic_worlds import bundled

pytestmark = pytest.mark.engine


def trace(steps=400, n=2):
    """Two vehicles that drive on at 10 m/s, far from each other."""
    box = np.zeros((steps, n, 5))
    box[:, :, 0] = np.arange(steps)[:, None] * 10 * DT + 500 * np.arange(n)
    box[:, :, 3:] = 4.5, 1.8
    zero, one = np.zeros((steps, n)), np.ones((steps, n), int)
    values: dict[str, Any] = {
        "box": box, "active": one > 0, "vehicle": one * np.arange(n), "lane": 0 * one, "s": zero + 20,
        "v": zero + 10, "a": zero, "side": 0 * one, "yielding": one < 0,
    }  # fmt: skip
    return Seen(**values)


def counted(seen):
    return {
        kind: [tuple(x) for x in np.argwhere(found)]
        for kind, found in odd(bundled("highway")[1], seen).items()
    }


def test_nothing_is_odd_about_an_even_drive():
    assert not any(counted(trace()).values())


def test_a_jerk_counts_once_and_not_where_a_vehicle_comes_to_a_stand():
    seen: Any = trace()
    seen.a[100:, 0] = -1.6
    seen.a[200:, 1] = -1.4
    seen.a[300, 1], seen.v[300, 1] = 2.0, 0.0
    assert counted(seen)["jerks"] == [(100, 0), (301, 1)]


def test_a_vehicle_that_turns_where_it_stands():
    seen: Any = trace()
    seen.v[50:, 0] = 0.1
    seen.box[50:, 0, 0] = seen.box[50, 0, 0]
    seen.box[60:, 0, 2] = 0.01
    assert counted(seen)["turns"] == [(60, 0)]


@pytest.mark.parametrize(
    ("first", "second", "after", "other", "taken_back"),
    [
        (1, -1, 140, False, True),
        (1, 1, 140, False, False),
        (1, -1, 160, False, False),
        (1, -1, 140, True, False),
    ],
)
def test_a_lane_change_that_is_taken_back(first, second, after, other, taken_back):
    seen: Any = trace()
    seen.side[50:90, 0] = first
    seen.side[50 + after : 90 + after, 0] = second
    if other:
        seen.vehicle[100:, 0] = 9  # another vehicle in the slot
    found = counted(seen)
    assert found["changes"] == [(50, 0), (50 + after, 0)]
    assert found["reversed"] == ([(50 + after, 0)] if taken_back else [])

"""Metrics as reductions in a `lax.scan` carry: fixed memory, one world, `vmap` for more.

`episode.EgoMetrics` runs all metrics of an ego, `traffic.TrafficMetrics` those of the flow; the other
modules hold the formulas.
"""

"""Metrics as reductions in a `lax.scan` carry: fixed memory, one world, `vmap` for more.

- `catalog` lists all columns of an episode with unit, formula, source and the rest of their descriptions;
- `measure` has the base classes: `Metric` of metrics of one's own, `Measure` of built-in ones;
- `measures` has the built-in measures of an ego, `ego` composes them, `traffic` measures the flow;
- `observer` connects them with a rollout, by way of the records of `record` and `step`;
- `safety`, `blame`, `motion` and `scores` hold the formulas, `reductions` what a scan carries.
"""

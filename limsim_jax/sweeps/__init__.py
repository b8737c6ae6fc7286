"""Sweeps over seeds: `experiment` files, `episode`, `runner`, results on disk (`store`), `cluster`."""

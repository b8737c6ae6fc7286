"""limsim_jax."""

"""Interactive replays: one HTML file each."""

from limsim_jax.report.viewer.measures import LOOK_AHEAD as LOOK_AHEAD
from limsim_jax.report.viewer.traffic import LONGEST_TTC as LONGEST_TTC
from limsim_jax.report.viewer.viewer import DRIVEN as DRIVEN
from limsim_jax.report.viewer.viewer import SUFFIXES as SUFFIXES
from limsim_jax.report.viewer.viewer import write_viewer as write_viewer

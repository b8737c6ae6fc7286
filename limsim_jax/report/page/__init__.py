"""The page of a sweep: one HTML file."""

from limsim_jax.report.page.page import get_ready as get_ready
from limsim_jax.report.page.page import write_report as write_report

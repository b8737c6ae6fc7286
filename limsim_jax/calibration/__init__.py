"""Calibration: drivers of car-following models from recordings, one by one and as a population."""

from limsim_jax.calibration.report import calibrate
from limsim_jax.calibration.result import Calibration

__all__ = ["Calibration", "calibrate"]

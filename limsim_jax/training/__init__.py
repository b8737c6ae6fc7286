"""Training of learned policies on our own rollouts: `hybrid` for PDM-Hybrid, `end_to_end` for that driver."""

from limsim_jax.training.hybrid import SCENARIOS as SCENARIOS
from limsim_jax.training.hybrid import Errors as Errors
from limsim_jax.training.hybrid import Report as Report
from limsim_jax.training.hybrid import Samples as Samples
from limsim_jax.training.hybrid import errors as errors
from limsim_jax.training.hybrid import fit as fit
from limsim_jax.training.hybrid import record as record
from limsim_jax.training.hybrid import train as train

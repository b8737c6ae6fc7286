"""Recorded vehicles from files: followers for calibration, tracks in the plane for replay."""

from limsim_jax.recordings.columns import read_columns
from limsim_jax.recordings.lanelets import Lanelet, lanelet_network
from limsim_jax.recordings.openacc import read_platoon
from limsim_jax.recordings.reader import as_recording, read_recording, read_recordings, read_tracks
from limsim_jax.recordings.recording import Defect, Recording, RecordingError, Source
from limsim_jax.recordings.tracks import Tracks

__all__ = [
    "Defect",
    "Lanelet",
    "Recording",
    "RecordingError",
    "Source",
    "Tracks",
    "as_recording",
    "lanelet_network",
    "read_columns",
    "read_platoon",
    "read_recording",
    "read_recordings",
    "read_tracks",
]

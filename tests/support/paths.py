"""Where the repository and the shared data lie."""

import os
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("LIMSIM_SHARED_DATA", REPO.parent / "shared" / "data"))
"""Maps and recordings that are too large for the repository."""

needs_shared = pytest.mark.skipif(
    not SHARED.is_dir(), reason=f"no shared data at {SHARED}; set LIMSIM_SHARED_DATA to their folder"
)

"""Maps: files to `Network` (host, exact) to `LaneMap` (device arrays)."""

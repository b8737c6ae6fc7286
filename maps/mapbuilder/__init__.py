"""Parts of `maps/generate.py`: curves, roads, junctions, and the OpenDRIVE writer."""

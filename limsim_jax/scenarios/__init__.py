"""Scenarios of other tools as worlds of ours."""

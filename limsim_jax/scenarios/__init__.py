"""Scenarios of other tools, and from instructions, as worlds of ours."""

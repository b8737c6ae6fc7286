"""Worlds beside other simulators, and in the shapes of other tools."""

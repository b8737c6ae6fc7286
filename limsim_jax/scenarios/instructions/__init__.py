"""Scenarios from a sentence: understood, placed on a map, tried, repaired or refused."""

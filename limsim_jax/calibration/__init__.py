"""Drivers from recordings: readers, cleaning, fits of car following, populations."""

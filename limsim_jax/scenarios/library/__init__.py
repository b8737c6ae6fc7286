"""The scenario library: a catalogue, scenarios of our own, and where those of others are."""

"""Worlds through time: `rollout` (one), `worlds` (many on all devices), `checkpoint` (fork, save, load)."""

"""Checkpoints, and which run each is of."""

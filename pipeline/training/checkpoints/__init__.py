"""Checkpoints, and the identity of the run that they belong to."""

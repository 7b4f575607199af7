"""Mistakes in pose files: whether given poses with each of them are refused by its name."""

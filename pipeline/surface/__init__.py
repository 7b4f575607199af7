"""Meshes, depth maps and videos of a trained scene."""

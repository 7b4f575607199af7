"""Readers of point clouds: PLY, LAS and LAZ, E57, and text."""

"""Rotations, similarity transforms, camera models and geodetic coordinates."""

"""Rotations, similarities, camera models and places on the ground."""

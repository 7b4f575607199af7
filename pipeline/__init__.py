"""Photogrammetry and 3D Gaussian splatting: the library that the stages call."""

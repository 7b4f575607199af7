"""Pixels: reading, RAW, undistortion, exposure."""

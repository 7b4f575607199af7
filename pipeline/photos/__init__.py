"""Photographs: RAW development, reading, undistortion and exposure."""

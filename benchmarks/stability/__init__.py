"""Stability of the whole pipeline on numerically extreme scenes."""

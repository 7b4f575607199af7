"""Poses of other programs: one module a program, and the registry of their formats."""

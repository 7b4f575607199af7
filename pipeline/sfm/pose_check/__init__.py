"""Comparison of given poses with the photographs' own matches."""

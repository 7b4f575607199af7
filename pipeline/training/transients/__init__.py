"""Transients: what only one or few photographs show, such as people who pass by."""

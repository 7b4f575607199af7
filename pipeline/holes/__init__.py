"""Invented content for the places that no photograph shows."""

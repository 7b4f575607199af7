"""Appearance of photographs: light, weather and processing that differ between them."""

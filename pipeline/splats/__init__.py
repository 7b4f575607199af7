"""Gaussians as values: the first ones, their order, and fewer of them."""

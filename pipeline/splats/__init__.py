"""Gaussians: parameters, initialisation, Morton order and reduction."""

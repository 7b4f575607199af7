"""Measures a machine with a GPU and many cores in one command, without a network."""

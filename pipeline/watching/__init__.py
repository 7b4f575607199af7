"""Monitoring of a training from a separate process: in a browser or in TensorBoard."""

"""Watching a training from outside, in a browser or in TensorBoard: it knows nothing of it."""

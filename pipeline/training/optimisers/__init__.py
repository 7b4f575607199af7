"""Adam for Gaussians and for cameras."""

"""Adam over Gaussians, and over the parameters of single cameras."""

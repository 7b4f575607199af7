"""The inputs of training: images, depths, initial Gaussians."""

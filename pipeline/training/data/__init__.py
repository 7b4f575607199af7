"""What training reads: images, depths, the first Gaussians."""

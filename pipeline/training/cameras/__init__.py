"""Camera refinement: poses and intrinsics that are optimised with the Gaussians."""

"""Camera refinement: poses and lenses that train with the Gaussians."""

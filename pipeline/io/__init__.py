"""File formats: COLMAP, transforms.json, LLFF, ground control points, EXIF, Gaussians."""

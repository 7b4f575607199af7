"""File formats: COLMAP, transforms.json, LLFF, EXIF, ground control, Gaussians."""

"""Speed and accuracy of the rasterizer: ``python -m benchmarks.raster --help``."""

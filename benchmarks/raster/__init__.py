"""How fast the rasterizer is, and how right: ``python -m benchmarks.raster --help``."""

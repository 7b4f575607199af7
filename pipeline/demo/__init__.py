"""A ray-traced scene with exact truth."""

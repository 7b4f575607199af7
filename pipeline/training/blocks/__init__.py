"""Training of a scene in blocks: a coarse model, the partition, the blocks, and their union."""

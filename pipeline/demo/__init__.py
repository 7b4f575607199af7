"""The demo scene: ray-traced photographs with exact ground truth."""

"""Multi-view stereo: depth maps of the views and a fused point cloud."""

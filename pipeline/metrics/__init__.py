"""Image quality, pose errors and the evaluation of views."""

"""Data types of a scene: photographs, cameras, poses, sparse points and views."""

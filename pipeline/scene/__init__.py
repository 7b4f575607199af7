"""A scene as plain values: photographs, cameras, poses, points, views."""

"""What the whole pipeline makes of scenes at the edge of what numbers hold."""

"""Coverage of a scene by its photographs: trust, defects, and viewpoints to add."""

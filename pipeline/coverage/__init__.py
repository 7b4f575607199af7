"""How well the photographs cover a scene: trust, defects, and viewpoints to add."""

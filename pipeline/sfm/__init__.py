"""Structure from motion: features, matching, mapping, verification, georeferencing."""

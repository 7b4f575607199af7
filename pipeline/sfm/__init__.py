"""Structure from motion: features, matching, mapping, judging, georeferencing."""

"""Maps of georeferenced scenes."""

"""Maps of a georeferenced scene: elevations, an orthophoto, a report on their accuracy."""

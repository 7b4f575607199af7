"""metrics.json and the pages."""

"""metrics.json, a scene's page, the page of all scenes, and tables of batches."""

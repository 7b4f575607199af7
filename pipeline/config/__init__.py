"""Options: schemas, presets, and the configuration of each run."""

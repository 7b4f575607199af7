"""Options: schemas, presets, and how a run's configuration is put together."""

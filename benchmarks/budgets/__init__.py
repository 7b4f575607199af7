"""Quality by training time."""

"""Running stages: folders, keys, locks, progress, errors and native libraries."""

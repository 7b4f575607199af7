"""How work is run: stages' folders and keys, progress, errors, native libraries."""

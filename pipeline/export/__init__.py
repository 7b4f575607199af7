"""The files that a finished scene is handed on as."""

"""Run time against error, each with the command that repeats it."""

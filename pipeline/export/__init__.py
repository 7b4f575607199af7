"""Export of a finished scene to the files of other programs."""

"""One module a stage: its declaration (``SPEC``) and the adapter between files and ``pipeline/``.

The Snakefile imports every module here, so the imports that cost time (torch, pycolmap, OpenCV)
stand inside the functions that do the work.
"""

"""One module per stage: its declaration (``SPEC``) and the adapter from files to ``pipeline/``.

The Snakefile imports every module, so slow imports (torch, pycolmap, OpenCV) belong inside the
functions that do the work.
"""

"""Fuzzing of the readers of files from others: ``python -m tests.fuzz --cases N``.

Small valid files, made by the project's own writers, are mutated (``mutations``); each reader
(``readers``) must return a value or raise a ``UserError``, within bounds of memory and time
(``campaign``). A case is its reader's name and its number, so that every finding can be repeated.
"""

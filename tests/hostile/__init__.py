"""Hostile and broken input, one module for each kind of it.

Each case ends with one ``UserError`` that names the file, or with a warning and what can still be
used. Tests below ``tests/e2e`` run some of them through Snakemake.
"""

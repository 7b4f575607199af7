"""The connection between the stages and Snakemake."""

"""What binds the stages to Snakemake."""

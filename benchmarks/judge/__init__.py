"""The judge of reconstructions against the truth, on a corpus made by code and on real photographs.

python -m benchmarks.judge [--cases NAME ...] [--seeds 0-4] [--data FOLDER] [--json FILE]
"""

"""The verdict on reconstructions (good, weak, failed) against ground truth, on synthetic captures
and on real photographs.

python -m benchmarks.judge [--cases NAME ...] [--seeds 0-4] [--data FOLDER] [--json FILE]
"""

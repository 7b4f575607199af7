"""For all tests."""

from __future__ import annotations

import os

# torch's own threads would spin beside the other worker's, and the references' arrays are small.
# Before torch is imported; the kernels' threads are given explicitly.
os.environ.setdefault("OMP_NUM_THREADS", "1")

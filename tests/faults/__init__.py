"""Fault injection: robots that stand and walk in the simulator, what can break on them, and what must come of it."""

import os

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")  # before numpy loads

"""Reference benchmark for distributed control of soft robotic arms."""

import os

__version__ = "0.1.0"

# Threads of torch and Numba that have nothing to do should sleep: by default they spin, which slows processes that
# share cores (a sweep, an evaluation beside a training) tens of times. It counts only if set before torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

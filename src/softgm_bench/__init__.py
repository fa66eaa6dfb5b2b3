"""Reference benchmark for distributed control of soft robotic arms."""

import os

__version__ = "0.1.0"

# Idle OpenMP threads of torch spin for milliseconds by default, which slows processes that share cores (a sweep, an
# evaluation beside a training) tens of times; sleeping at once halves the speed of a process that is alone. Spinning
# for microseconds loses neither. It counts only if set before torch is loaded.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "2000")

# oneDNN multiplies float32 matrices twice as fast as MKL on AMD's cores (the training loop chooses it), through a
# setting that would let it round them to bfloat16 where the CPU has instructions for that; this forbids it. It counts
# only if set before the first product.
os.environ.setdefault("ONEDNN_MAX_CPU_ISA", "AVX512_CORE")

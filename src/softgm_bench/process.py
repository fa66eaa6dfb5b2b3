"""Environment variables that count only if they are set before torch is loaded, or before its first product.

Entry points call ``prepare`` first: commands, and the package when it is asked for a part of its Python interface.
"""

import os
import sys
import warnings

SETTINGS = {
    # Idle OpenMP threads of torch spin for milliseconds by default, which slows processes that share cores (a sweep,
    # an evaluation beside a training) tens of times; sleeping at once halves the speed of a process that is alone.
    # Spinning for microseconds loses neither.
    "GOMP_SPINCOUNT": "2000",
    # oneDNN multiplies float32 matrices twice as fast as MKL on AMD's cores (``runs.machine`` chooses it), through a
    # setting that would let it round them to bfloat16 where the CPU has instructions for that; this forbids it.
    "ONEDNN_MAX_CPU_ISA": "AVX512_CORE",
}


def prepare() -> None:
    """Set what the user has not set; ``OMP_WAIT_POLICY`` says how threads wait, too."""
    for name, value in SETTINGS.items():
        if not (name == "GOMP_SPINCOUNT" and "OMP_WAIT_POLICY" in os.environ):
            os.environ.setdefault(name, value)


def allow_bf16() -> None:
    """Let oneDNN round to bfloat16, which ``prepare`` has forbidden; what the user has set stays."""
    name = "ONEDNN_MAX_CPU_ISA"
    if os.environ.get(name) == SETTINGS[name]:
        del os.environ[name]


def quieten() -> None:
    """Keep warnings of libraries from users of a command, who can do nothing about them.

    ``python -W default`` or ``PYTHONWARNINGS`` shows them; the Python interface leaves them alone.
    """
    if not sys.warnoptions:
        warnings.simplefilter("ignore")

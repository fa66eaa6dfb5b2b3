"""Keep a trained policy as one small file: ``python -m softgm_bench.export RUN_FOLDER_OR_CHECKPOINT FILE``."""

import argparse
import sys
from pathlib import Path

from softgm_bench.config import UserError


def main() -> int:
    """0, or 2 after one line about what is wrong."""
    parser = argparse.ArgumentParser(prog="python -m softgm_bench.export", description=__doc__)
    parser.add_argument("source", type=Path, help="run folder, whose newest checkpoint is taken, or checkpoint")
    parser.add_argument("file", type=Path, help="to be written or replaced")
    arguments = parser.parse_args()
    from softgm_bench.episodes import policy  # late: help need not wait for torch

    try:
        trained = policy.load(arguments.source)
        policy.save(trained, arguments.file)
    except UserError as error:
        print(f"softgm_bench.export: {error}", file=sys.stderr)
        return 2
    print(f"{trained.config.label} on {trained.config.task.name} after {trained.frames} frames: {arguments.file}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Keep a trained policy as one small file: ``softgm-bench export SOURCE FILE``.

SOURCE is a run folder, whose newest checkpoint is taken, or a checkpoint. FILE is written, or replaced.
"""

import sys
from pathlib import Path

from softgm_bench import command
from softgm_bench.errors import UserError


def main() -> int:
    """Run what the command line says; 0, or 2 after one line about what is wrong."""
    return command.run("export", __doc__, _export)


def _export(arguments: list[str]) -> None:
    if len(arguments) != 2 or any(argument.startswith("-") for argument in arguments):
        found = ", ".join(arguments) or "nothing"
        raise UserError(f"found {found}: give a run folder or checkpoint, and the file to write")
    source, file = map(Path, arguments)
    from softgm_bench.episodes import policy  # late: a refused command need not wait for torch

    trained = policy.load(source)
    policy.save(trained, file)
    print(f"{trained.config.label} on {trained.config.task.name} after {trained.frames} frames: {file}")


if __name__ == "__main__":
    sys.exit(main())

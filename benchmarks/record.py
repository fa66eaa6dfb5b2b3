"""Results as JSON files that say on what they were measured."""

import json
import os
import platform
import re
from pathlib import Path
from typing import Any

from softgm_bench.storage.versions import version_of

PACKAGES = ("softgm-bench", "pyelastica", "numba", "torch", "numpy", "scipy")


def versions() -> dict[str, str]:
    return {name: version_of(name) for name in PACKAGES} | {"python": platform.python_version()}


def machine() -> dict[str, Any]:
    return {"processor": _processor(), "cores": os.cpu_count()}


def write(path: Path, result: dict[str, Any], silently: bool = False) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"machine": machine(), "versions": versions()} | result, indent=2)
    text = re.sub(r"\[[^][{}\"]*\]", lambda numbers: " ".join(numbers[0].split()), text)  # a row of numbers, a line
    path.write_text(text + "\n")
    if not silently:
        print(f"written to {path}")


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else ():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor()

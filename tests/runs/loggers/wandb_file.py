"""Reads a W&B transaction log: LevelDB's log format, blocks of 32 KiB with records in up to four kinds of pieces."""

import json
import struct
import time

from google.protobuf.message import DecodeError
from wandb.proto import wandb_internal_pb2

BLOCK, HEADER = 32768, 7
FULL, FIRST, MIDDLE, LAST = 1, 2, 3, 4


def records(path):
    """Every record of a ``.wandb`` file."""
    content, at, whole = path.read_bytes(), HEADER, b""
    while at + HEADER <= len(content):
        left = BLOCK - at % BLOCK
        if left < HEADER:
            at += left
            continue
        _, length, kind = struct.unpack_from("<IHB", content, at)
        if kind not in (FULL, FIRST, MIDDLE, LAST):
            at += left
            continue
        piece = content[at + HEADER : at + HEADER + length]
        whole = piece if kind in (FULL, FIRST) else whole + piece
        at += HEADER + length
        if kind in (FULL, LAST):
            record = wandb_internal_pb2.Record()
            record.ParseFromString(whole)
            yield record


def wait_for_end(path, seconds=60.0):
    """Wait until the run's exit is written: W&B's own process may write it after ``finish`` has returned."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        try:
            if any(record.HasField("exit") for record in records(path)):
                return
        except DecodeError:  # the last record is half written
            pass
        time.sleep(0.1)
    raise TimeoutError(f"{path}: no end of the run within {seconds} s")


def _items(items):
    """Plain values by name, nested names joined with dots."""
    return {item.key or ".".join(item.nested_key): json.loads(item.value_json) for item in items}


def history(path):
    """Rows as they were logged."""
    return [_items(record.history.item) for record in records(path) if record.HasField("history")]


def config(path):
    """The configuration as it was first noted."""
    (run,) = [record.run for record in records(path) if record.HasField("run")][:1]
    return _items(run.config.update)


def summary(path):
    """The summary's last value of every name."""
    found = {}
    for record in records(path):
        if record.HasField("summary"):
            found |= _items(record.summary.update)
    return found

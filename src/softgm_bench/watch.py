"""Watch a run learn: ``softgm-bench watch RUN [key=value ...]``.

RUN is the folder of a run that is at work, or of one that has ended. An address on this machine, which no other can
reach, shows its newest checkpoint play an episode, as an interactive page; as soon as there is a newer checkpoint, that
one plays. Ctrl-C ends it and does not touch the run. Settings, with their defaults:

  seed=0 episode=0     which episode of an evaluation
  horizon=200          control steps at most
  threads=1            beside a training, more would slow it down
  port=8765            of the address; 0: any that is free
"""

import csv
import json
import sys
import threading
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any

from softgm_bench import command
from softgm_bench.config import available_threads
from softgm_bench.config.explain import USER_ERRORS, explain
from softgm_bench.errors import UserError
from softgm_bench.storage.run_folder import RunFolder

HOST = "127.0.0.1"
OWN_NAMES = (HOST, "localhost")  # of this machine; a page elsewhere could have its name lead here


@dataclass
class Options:
    """The command's settings; meanings above."""

    seed: int = 0
    episode: int = 0
    horizon: int = 200
    threads: int = 1
    port: int = 8765

    def check(self) -> None:
        """Refuse values that make no sense.

        Raises:
            UserError: naming the first such setting, its value and what would be right.
        """
        ranges = {"horizon": (1, 100_000), "threads": (1, available_threads()), "port": (0, 65_535)}
        for name, (low, high) in ranges.items():
            if not low <= getattr(self, name) <= high:
                raise UserError(f"{name}={getattr(self, name)}: choose {low} to {high}")
        for name in ("seed", "episode"):
            if getattr(self, name) < 0:
                raise UserError(f"{name}={getattr(self, name)}: it must be 0 or more")


def main() -> int:
    """Run what the command line says; 0, or 2 after one line about what is wrong."""
    return command.run("watch", __doc__, _watch)


def _watch(arguments: list[str]) -> None:
    path, options, _ = command.parse(arguments, Options, "run folder")
    options.check()
    run = RunFolder(path)
    if not run.config.exists():
        raise UserError(f"{path}: no run here; name a run's folder, which holds config.yaml")
    try:
        server = serve(Show(run, options), options.port)
    except OSError as error:
        raise UserError(f"port={options.port}: {error.strerror}; choose another, or port=0") from error
    print(f"watching {path} at http://{HOST}:{server.server_address[1]}/ until Ctrl-C", flush=True)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        print("stopped watching; the run goes on as it was", file=sys.stderr)
    finally:
        server.server_close()


class Show:
    """A run as it is now: where its training is, and an episode of its newest checkpoint, recorded once for each."""

    def __init__(self, run: RunFolder, options: Options) -> None:
        """Record nothing yet."""
        self._run, self._options = run, options
        self._lock = threading.Lock()
        self._shown: Path | None = None
        self._page = ""

    def state(self) -> dict[str, Any]:
        """The newest checkpoint's name, ``None`` before the first; frames and success of the newest iteration."""
        newest = self._run.newest()
        row = _last_row(self._run.metrics)
        return {
            "run": str(self._run.path),
            "checkpoint": newest.name if newest is not None else None,
            "frames": int(float(row["frames"])) if row.get("frames") else 0,
            "success": row.get("success_rate") or None,
            "finished": self._run.summary.exists(),
        }

    def episode(self) -> str:
        """The page of an episode that the newest checkpoint plays.

        Raises:
            UserError: there is no checkpoint yet, it is of another version, or the task has no arm.
        """
        from softgm_bench.episodes import policy, recording  # late: torch takes seconds
        from softgm_bench.render.html import render_page
        from softgm_bench.runs.machine import set_threads

        with self._lock:
            newest = self._run.newest()
            if newest is None:
                raise UserError(f"{self._run.path}: no checkpoint yet")
            if newest != self._shown:
                chosen = self._options
                set_threads(chosen.threads)
                trained = policy.load(newest)
                episode = recording.record(
                    trained,
                    chosen.seed,
                    chosen.episode,
                    min(chosen.horizon, trained.config.task.horizon),
                    attention=True,
                )
                self._page, self._shown = render_page(episode), newest
            return self._page


def serve(show: Show, port: int) -> ThreadingHTTPServer:
    """A server on this machine's own address; ``serve_forever`` of it answers.

    Raises:
        OSError: the port is taken.
    """
    viewer = files("softgm_bench.render").joinpath("viewer", "watch.html").read_text(encoding="utf-8")

    class Handler(BaseHTTPRequestHandler):
        """Answers three addresses, to this machine alone."""

        def do_GET(self) -> None:
            """Give the frame, the run's state or the episode."""
            address = self.path.partition("?")[0]
            if self.headers.get("Host", "").rpartition(":")[0] not in OWN_NAMES:
                self._answer(HTTPStatus.FORBIDDEN, "only this machine may watch", "text/plain")
            elif address == "/":
                self._answer(HTTPStatus.OK, viewer, "text/html")
            elif address == "/state":
                self._answer(HTTPStatus.OK, json.dumps(show.state()), "application/json")
            elif address == "/episode":
                try:
                    self._answer(HTTPStatus.OK, show.episode(), "text/html")
                except USER_ERRORS as error:
                    self._answer(HTTPStatus.SERVICE_UNAVAILABLE, explain(error, []), "text/plain")
            else:
                self._answer(HTTPStatus.NOT_FOUND, "nothing here", "text/plain")

        def _answer(self, status: HTTPStatus, text: str, kind: str) -> None:
            content = text.encode()
            self.send_response(status)
            self.send_header("Content-Type", f"{kind}; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *values: Any) -> None:
            """Say nothing of each request."""

    return ThreadingHTTPServer((HOST, port), Handler)


def _last_row(path: Path) -> dict[str, str]:
    """The newest iteration's row of ``metrics.csv``; empty before the first one is whole."""
    try:
        with path.open(newline="") as file:
            rows = [line for line in file if line.endswith("\n")]
    except OSError:
        return {}
    return dict(next(csv.DictReader([rows[0], rows[-1]]))) if len(rows) > 1 else {}


if __name__ == "__main__":
    sys.exit(main())

"""A data set whose writing is interrupted."""

from softgm_bench.datasets import chunks


def interrupt_second_chunk(monkeypatch):
    """As by Ctrl-C, once, while the second chunk from now on is written; later ones are written."""
    original, calls = chunks.write, []

    def interrupted(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt
        original(*arguments)

    monkeypatch.setattr(chunks, "write", interrupted)

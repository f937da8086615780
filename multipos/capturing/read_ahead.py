"""Bytes taken as they come, by a thread of its own, so that none is lost while a fit goes on.

`read_ahead` hands on what has come since the last time. A serial port holds a tenth of a second of
a fast sensor, a socket a quarter. What has come is handed on twenty times a second, as often as a
page can show it: what that costs is by the occasion and hardly by the row, so that row by row would
cost twenty times as much.
"""

import threading
from collections.abc import Generator
from contextlib import closing
from itertools import groupby

Chunks = Generator[bytes | None, None, None]  # as they come; None: the connection is lost
MOMENT = 0.05  # [s]
_MOST = 1 << 20  # bytes that wait; they are handed on then, and a pipe waits
_PATIENCE = 0.1  # [s] for the thread to end


def read_ahead(chunks: Chunks) -> Chunks:
    """Yield what has come since the last time, b"" where nothing has; None where it was lost.

    Parameters
    ----------
    chunks : generator of bytes or None
        Is closed in the end. It gives something several times a second, if only b"", unless it
        cannot be made to end.
    """
    reader = _Reader(chunks)
    reader.start()
    try:
        while True:
            waiting, ended = reader.take()
            for lost, together in groupby(waiting, key=lambda chunk: chunk is None):
                yield None if lost else b"".join(filter(None, together))
            if ended:
                return
            if not waiting:
                yield b""
    finally:
        reader.stop()


class _Reader(threading.Thread):
    """Reads, and waits where nobody takes it."""

    def __init__(self, chunks: Chunks) -> None:
        super().__init__(daemon=True)  # stdin cannot be made to end
        self._chunks = chunks
        self._changed = threading.Condition()
        self._waiting: list[bytes | None] = []
        self._size = 0
        self._ended = self._stopped = False
        self._error: Exception | None = None

    def run(self) -> None:
        try:
            with closing(self._chunks):
                for chunk in self._chunks:
                    if not self._add(chunk):
                        break
        except Exception as error:  # raised again where the bytes are taken
            self._error = error
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _add(self, chunk: bytes | None) -> bool:
        """Keep a chunk until it is taken; tell whether to go on."""
        with self._changed:
            if chunk != b"":
                self._waiting.append(chunk)
                self._size += len(chunk or b"")
            if self._is_full():
                self._changed.notify_all()
                self._changed.wait_for(lambda: not self._is_full() or self._stopped)
            return not self._stopped

    def _is_full(self) -> bool:
        return self._size >= _MOST

    def take(self) -> tuple[list[bytes | None], bool]:
        """Return what comes within a moment, and whether that is all.

        Raises
        ------
        Exception
            That of the source, once all that came before it has been taken.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._is_full() or self._ended, timeout=MOMENT)
            ended = self._ended
            waiting, self._waiting, self._size = self._waiting, [], 0
            self._changed.notify_all()
        if ended and not waiting and self._error is not None:
            raise self._error
        return waiting, ended and self._error is None

    def stop(self) -> None:
        """End the thread."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self.join(_PATIENCE)

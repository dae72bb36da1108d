"""Firing records on their way into a file: each is encoded as it comes, and waits on the disk for its turn."""

from __future__ import annotations

import tempfile
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.copying import Copy, Origin
from dataflow.records.cuts import taken_by
from dataflow.records.firing import CALLS, FiringRecord, consecutive, encode_batch

BATCH = 64
"""Firing records that are written together."""
LATEST = 2**63 - 1


@contextmanager
def _refused(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise RecordingError(f"{folder} does not take the firing records that are to be sorted: {error}") from error


class Spool:
    """Holds firing records of all operators until they are written in the order of stamps. A context manager.

    `folder`: where there is room for them. Raises `RecordingError` where there is none.
    """

    def __init__(self, folder: Path, records: Mapping[str, Iterable[FiringRecord]]) -> None:
        self.calls = 0
        self.left_out = False
        """True where records stand in for calls that are left out."""
        self._operators = sorted(records)
        self._named = list(records)
        self._stamps, self._places, self._makers = array("q"), array("q", [0]), array("q")
        with _refused(folder):
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed with this
        try:
            with _refused(folder):
                for number, operator in enumerate(self._operators):
                    self._take(number, records[operator])
                self._file.flush()
        except BaseException:
            self._file.close()
            raise

    def _take(self, number: int, records: Iterable[FiringRecord]) -> None:
        for batch in consecutive(records, BATCH):
            self.calls += sum(r.kind in CALLS for r in batch)
            self.left_out = self.left_out or any(r.kind == "cut" and taken_by(r) is not None for r in batch)
            self._stamps.append(min(batch[-1].stamp, LATEST))
            self._makers.append(number)
            self._places.append(self._places[-1] + self._file.write(encode_batch(batch)))

    def write(self, copy: Copy, origins: Sequence[Origin]) -> None:
        """Writes the records, those of all operators in the order of stamps."""
        first = max(1, min((span[0] for origin in origins if (span := origin.span()) is not None), default=1))
        stamps = np.maximum(np.asarray(self._stamps, np.int64), min(first, LATEST))
        makers, places = np.asarray(self._makers, np.int64), np.asarray(self._places, np.int64)
        ids = {operator: copy.firings_channel(origins[0].namespace, operator) for operator in self._named}
        channels, sequences = [ids[operator] for operator in self._operators], [0] * len(self._operators)
        for k in np.lexsort((makers, stamps)):
            maker = int(makers[k])
            self._file.seek(places[k])
            data = self._file.read(int(places[k + 1] - places[k]))
            copy.record(channels[maker], int(stamps[k]), sequences[maker], data)
            sequences[maker] += 1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

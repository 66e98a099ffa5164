"""Sources whose recordings are one ``tf.train.Example`` each, in files of TFRecords."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from hvf.data.importing.example import Example
from hvf.data.importing.importer import Source
from hvf.data.importing.tfrecord import Record, records_of

T = TypeVar("T")


class RecordSource(Source):
    """Episodes of files of records, in order (:class:`~hvf.data.importing.importer.Source`).

    Args:
        files: the files.

    Raises:
        FileNotFoundError, ValueError: as :func:`~hvf.data.importing.tfrecord.open_records`.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self.files = files
        self._records: list[Record] = records_of(files)

    def name_of(self, number: int) -> str:
        """A recording, for errors."""
        return str(self._records[number])

    def _parsed(self, number: int, parse: Callable[[Example], T]) -> T:
        """What ``parse`` makes of the features of a record.

        Raises:
            ValueError: the record is damaged, or ``parse`` cannot take it; names it.
        """
        record = self._records[number]
        data = record.read()
        try:
            return parse(Example(data))
        except ValueError as error:
            raise ValueError(f"{record}: {error}") from error

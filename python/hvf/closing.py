"""What has to be closed, and is at the end of a ``with`` statement."""

from __future__ import annotations

from types import TracebackType
from typing import TypeVar

ClosingT = TypeVar("ClosingT", bound="Closing")


class Closing:
    """Closes itself at the end of a ``with`` statement, however that ends."""

    def close(self) -> None:
        """Give back what is held; again, and nothing happens."""

    def __enter__(self: ClosingT) -> ClosingT:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

"""Things that are named and imported when they are needed."""

from __future__ import annotations

import importlib
from typing import Any


def imported(target: str) -> Any:
    """What ``"module:attribute"`` names.

    Raises:
        ImportError: no such module, or it has no such attribute.
    """
    module, _, attribute = target.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except AttributeError as error:
        raise ImportError(f"{target}: {module} has no {attribute!r}") from error

"""``hvf collect DOMAIN``: data from random interaction."""

from __future__ import annotations

from collections.abc import Sequence

from hvf.cli.arguments import domain_named, parsed
from hvf.importing import imported


def run(words: Sequence[str]) -> None:
    """Collect episodes under random actions into one file; a stopped collection is gone on with.

    Raises:
        ValueError: a domain in which nothing can be collected.
    """
    domain, rest = domain_named("collect", words)
    kind = domain.collection
    if kind is None:
        raise ValueError(f"domain: nothing can be collected in {domain.name}")
    config = imported(kind) if isinstance(kind, str) else kind
    parsed(config, f"collect {domain.name}", rest).run()

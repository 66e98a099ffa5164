"""``hvf report DOMAIN``: what models make of many held-out recorded episodes."""

from __future__ import annotations

from collections.abc import Sequence

from hvf.cli.arguments import domain_named, on_recorded


def run(words: Sequence[str]) -> None:
    """Make the report, write and print it."""
    domain, rest = domain_named("report", words)
    from hvf.experiments.video_report import VideoReport, report  # torch, which takes a second

    report(domain, on_recorded(VideoReport, "report", domain, rest))

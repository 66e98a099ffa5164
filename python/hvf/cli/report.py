"""``hvf report DOMAIN``: what models make of many held-out recorded episodes."""

from __future__ import annotations

from collections.abc import Sequence

from hvf.cli.arguments import domain_named, searching_with


def run(words: Sequence[str]) -> None:
    """Make the report, write and print it."""
    domain, rest = domain_named("report", words)
    from hvf.experiments.video_report import VideoReport, report  # torch, which takes a second

    config = searching_with(VideoReport, f"report {domain.name}", domain, rest, ["data"])
    report(domain, config)

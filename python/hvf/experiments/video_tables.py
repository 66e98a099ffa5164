"""A report on recorded episodes as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

_SOURCES = {
    "drawn": "drawn by the generator",
    "retrieved": "frames of the most similar training episode",
    "copied": "the conditioning image, copied",
}


def markdown(report: Mapping[str, Any]) -> str:
    """Tables of a report (:func:`hvf.experiments.video_report.report`)."""
    summary, split = report["summary"], report["data"]["parameters"].get("split", "validation")
    split = "test" if split == "test" else "validation"
    count = summary["episodes"]
    parts = [f"# {report['data']['environment']}: {count} held-out episodes ({split})"]
    models = [f"{part} {weights['model']}" for part, weights in report["weights"].items()]
    parts.append(f"Models: {', '.join(models)}. Distances and costs are squared L2 per pixel.")
    if "hardest_segment" in summary:
        parts += ["## Planning cost", _plans(report["episodes"], summary)]
    if "prediction" in summary:
        parts += ["## Prediction", _prediction(summary["prediction"])]
    if "scene" in summary:
        parts += ["## Are images of the scene?", _scenes(summary)]
    elif "generator" in report["weights"]:
        parts.append("Whether images are of their scene is told from two held-out episodes on.")
    return "\n\n".join(parts) + "\n"


def _plans(records: Sequence[Mapping[str, Any]], summary: Mapping[str, Any]) -> str:
    planned = [record for record in records if "segment_costs" in record]
    rows = [
        [
            str(record["episode"]),
            ", ".join(f"{cost:.3g}" for cost in record["segment_costs"]),
            f"{max(record['segment_costs']):.3g}",
            f"{record['cost_without_subgoals']:.3g}",
        ]
        for record in planned
    ]
    rows.append(
        ["mean", "", f"{summary['hardest_segment']:.3g}", f"{summary['without_subgoals']:.3g}"]
    )
    easier = f"The hardest segment costs less in {summary['easier']:.0%} of the episodes."
    return _table(["episode", "segments", "hardest segment", "without subgoals"], rows, easier)


def _prediction(figures: Mapping[str, Sequence[float]]) -> str:
    steps = range(len(figures["psnr"]))
    rows = [
        [str(step + 1), *(f"{values[step]:.3f}" for values in figures.values())] for step in steps
    ]
    said = "`still` is the last frame seen, copied."
    return _table(["steps ahead", *(name.replace("_", " ") for name in figures)], rows, said)


def _scenes(summary: Mapping[str, Any]) -> str:
    rows = [
        [
            _SOURCES[name],
            f"{figures['kept']:.0%}",
            *(f"{figures[key]:.4f}" for key in ("own", "other", "conditioning", "spread")),
        ]
        for name, figures in summary["scene"].items()
    ]
    columns = ["images", "own scene is nearest", "to own episode", "to another", "to conditioning"]
    said = (
        f"By chance {summary['chance']:.0%}. True frames of an episode are "
        f"{summary['true_spread']:.4f} apart."
    )
    return _table([*columns, "apart"], rows, said)


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]], said: str) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + f"\n\n{said}"

"""All benches in one run: criterion's and the scripts beside this one, kept as one JSON file.

    python benchmarks/run.py --out outputs/bench.json
    python benchmarks/run.py --only planner layers --against benchmarks/history/0.1.0.json

The file says which code ran on which machine, and how busy that was with other work. With
``--against`` a table follows: how many times faster each figure is than in an earlier file. Figures
of two machines, or of a busy one, say little of the code.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from hvf.evaluation.code import code_of

HERE = Path(__file__).parent
SCRIPTS = tuple(sorted(path.stem for path in HERE.glob("*.py") if path != Path(__file__)))
RATES = ("per_second", "per_processor_second")
"""Names of figures of which more is better; of all others (seconds, calls) less is."""


def benches() -> tuple[str, ...]:
    """Names of criterion's benches."""
    return tuple(sorted(path.stem for path in (HERE.parent / "crates/hvf-core/benches").glob("*")))


def criterion(chosen: list[str]) -> dict[str, float]:
    """Median seconds by the full name of each measurement of the benches."""
    begin = time.time()
    words = [word for name in chosen for word in ("--bench", name)]
    subprocess.run(["cargo", "bench", "-p", "hvf-core", *words], cwd=HERE.parent, check=True)
    target = Path(os.environ.get("CARGO_TARGET_DIR", HERE.parent / "target"))
    found = {}
    for path in (target / "criterion").rglob("new/estimates.json"):
        if path.stat().st_mtime >= begin:
            name = json.loads((path.parent / "benchmark.json").read_text())["full_id"]
            median = json.loads(path.read_text())["median"]["point_estimate"]
            found[name] = median / 1e9
    return found


def script(name: str) -> Any:
    """Run a script; what its last line says, which is JSON."""
    command = [sys.executable, str(HERE / f"{name}.py")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=HERE.parent) as process:
        assert process.stdout is not None
        last = ""
        for last in process.stdout:
            print(last, end="", flush=True)
    if process.returncode:
        raise SystemExit(f"benchmarks/{name}.py failed with {process.returncode}")
    return json.loads(last)


def machine() -> dict[str, Any]:
    """What the figures depend on beside the code."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": models[0] if models else platform.processor(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
    }


def figures(part: Any, name: str = "") -> Iterator[tuple[str, float, bool]]:
    """Each number of a nest of mappings: its name, value, and whether more is better."""
    if isinstance(part, Mapping):
        for key, value in part.items():
            yield from figures(value, f"{name}, {key}" if name else str(key))
    elif isinstance(part, int | float):
        yield name, float(part), any(name.endswith(rate) for rate in RATES)


def ratios(now: Mapping[str, Any], before: Mapping[str, Any]) -> Table:
    """How many times faster each figure is now, of those that both have."""
    old = {name: value for name, value, _ in figures(before["figures"])}
    table = Table("figure", "before", "now", "times faster")
    for name, value, rate in figures(now["figures"]):
        was = old.get(name)
        if was and value:
            ratio = value / was if rate else was / value
            table.add_row(name, f"{was:.4g}", f"{value:.4g}", f"{ratio:.2f}")
    return table


def main() -> None:
    about = (__doc__ or "").partition("\n")[0]
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--out", type=Path, default=Path("outputs/bench.json"))
    parser.add_argument("--against", type=Path, help="an earlier file to compare with")
    names = sorted({*benches(), *SCRIPTS})
    parser.add_argument("--only", nargs="+", choices=names, help="some of them", default=names)
    chosen = parser.parse_args()
    before = json.loads(chosen.against.read_text()) if chosen.against else None
    result: dict[str, Any] = {"machine": machine(), "code": code_of()}
    compiled = [name for name in benches() if name in chosen.only]
    result["figures"] = {"criterion": criterion(compiled)} if compiled else {}
    for name in SCRIPTS:
        if name in chosen.only:
            print(f"== benchmarks/{name}.py", flush=True)
            result["figures"][name] = script(name)
    chosen.out.parent.mkdir(parents=True, exist_ok=True)
    chosen.out.write_text(json.dumps(result, indent=1) + "\n")
    print(f"wrote {chosen.out}")
    if before is not None:
        Console().print(ratios(result, before))


if __name__ == "__main__":
    main()

"""Kill a verb of the command line at a random moment, start it again, and look at what is lost.

    python tests/kill_and_resume.py --verb train --times 20 --seed 0

The job runs once without a stop. Then, each time in a folder of its own, it is killed (SIGKILL to
its main process, as by a machine that runs out of memory) at a moment that is uniform over the
time that it took, and started again. Checked is that

* nothing outlives the killed process for long;
* every unit of work (a part of episodes, the steps between two checkpoints, a trial) is saved when
  it is done, before the next one is finished, and what is saved is not done again: at most the
  unit that was in the making is lost (of a verb that runs several processes: one for each);
* the result is the uninterrupted run's, but for the times that it tells.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import processes


@dataclasses.dataclass(frozen=True)
class Job:
    """A verb with little to do.

    Attributes:
        words: its command line; ``{out}`` is a folder, ``{data}`` a file of a few episodes.
        saves: pattern of the files that hold finished units.
        unit: how much a file grows with one unit of work.
        result: pattern of the files that are the result.
    """

    words: str
    saves: str
    unit: int
    result: str


JOBS: Mapping[str, Job] = {
    "collect": Job(
        "collect maze --out {out}/maze.h5 --episodes 600 --steps 50 --part 20 --seed 5",
        saves="maze.h5.parts/0*.h5",
        unit=1,
        result="maze.h5",
    ),
    "train": Job(
        "train cvae --data {data} --out {out} --batch-size 4 --model.pyramid-levels 1"
        " --loop.steps 40 --loop.checkpoint-every 4 --loop.validate-every 20 --loop.threads 1",
        saves="training.safetensors",
        unit=4,
        result="*.safetensors",
    ),
    "eval": Job(
        "eval maze --task hard --method hvf --dynamics simulator --trials 16 --samples 30"
        " --elites 6 --subgoal-samples 20 --subgoal-elites 5 --out {out}/report.json",
        saves="report.json",
        unit=1,
        result="report.json",
    ),
    "paper": Job(
        "paper maze --only reduction --preset default --world simulator --split validation"
        " --trials 1 --workers 2 --out {out}",
        saves="**/*.json",
        unit=1,
        result="**/*.json",
    ),
}
DATA = "collect maze --out {data} --episodes 20 --steps 10 --image-size 64"

# Imported by every Python that a verb starts, the verb's own included: one line for each file that
# takes its place, with how many units it holds then.
JOURNAL = """
import json, os, sys
sys.path.insert(0, os.environ["KILL_TESTS"])
from kill_and_resume import units

def note(event, arguments):
    if event == "os.rename":
        held = units(os.fsdecode(arguments[0]), os.fsdecode(arguments[1]))
        line = json.dumps([os.path.realpath(os.fsdecode(arguments[1])), held])
        with open(os.environ["KILL_JOURNAL"], "a") as journal:
            journal.write(line + "\\n")

sys.addaudithook(note)
"""


def units(content: str, name: str) -> int:
    """How much finished work the file ``content``, about to be named ``name``, holds."""
    if name.endswith(".json"):
        return len(json.loads(Path(content).read_text()).get("trials", []))
    if name.endswith("training.safetensors"):
        return int(_header(Path(content))["__metadata__"]["step"])
    return 1


def _header(path: Path) -> Any:
    with path.open("rb") as file:
        return json.loads(file.read(int.from_bytes(file.read(8), "little")))


@dataclasses.dataclass(frozen=True)
class Run:
    """One run of a job in a folder: what it saved, in order, and how long it took."""

    saved: list[tuple[Path, int]]
    seconds: float
    status: int


class Verb:
    """A verb of ``JOBS`` at work in folders below ``folder``."""

    def __init__(self, name: str, folder: Path) -> None:
        self.name = name
        self.job = JOBS[name]
        self.folder = folder.resolve()
        self.data = self.folder / "data.h5"
        site = self.folder / "site"
        site.mkdir(parents=True)
        (site / "sitecustomize.py").write_text(JOURNAL)
        path = [str(site), *filter(None, [os.environ.get("PYTHONPATH")])]
        self._env = {
            "PYTHONPATH": ":".join(path),
            "KILL_TESTS": str(Path(__file__).parent.resolve()),
            "OMP_NUM_THREADS": "1",
        }
        if "{data}" in self.job.words:
            words = DATA.format(data=self.data).split()
            processes.run([*processes.HVF, *words], check=True)

    def run(self, out: Path, kill_after: float | None = None) -> Run:
        """Run it in ``out``, to its end or for so many seconds, until nothing of it is left."""
        out.mkdir(exist_ok=True)
        journal = out.with_name(f"{out.name}.journal")
        journal.unlink(missing_ok=True)
        words = self.job.words.format(out=out, data=self.data).split()
        env = {**self._env, "KILL_JOURNAL": str(journal)}
        begin = time.monotonic()
        with processes.started([*processes.HVF, *words], env=env) as child:
            if kill_after is not None:
                while child.running and time.monotonic() < begin + kill_after:
                    time.sleep(0.001)
                child.tell_it_alone(signal.SIGKILL)
            status = child.wait()
            child.wait_until_gone()
        if kill_after is None:
            assert status == 0, f"{self.name}: status {status}\n{child.output}\n{child.errors}"
        lines = journal.read_text().splitlines(keepends=True) if journal.exists() else []
        # The last line may be half a line.
        found = [json.loads(line) for line in lines if line.endswith("\n")]
        saved = [(Path(name), held) for name, held in found]
        mine = [(path, held) for path, held in saved if path.match(self.job.saves)]
        return Run(mine, time.monotonic() - begin, status)

    def held(self, out: Path) -> dict[Path, int]:
        """What the files in ``out`` hold: finished units by file."""
        return {path: units(str(path), path.name) for path in out.glob(self.job.saves)}

    def result(self, out: Path) -> dict[str, Any]:
        """The result's content by file, without times."""
        found: dict[str, Any] = {}
        for path in sorted(out.glob(self.job.result)):
            content: Any = path.read_bytes()
            if path.suffix == ".json":
                content = _timeless(json.loads(content))
            elif path.suffix == ".safetensors":  # the order of words in its header is any
                content = (_header(path), content[8 + int.from_bytes(content[:8], "little") :])
            found[str(path.relative_to(out))] = content
        return found


def check(name: str, times: int, seed: int, folder: Path) -> list[str]:
    """Kill a verb and start it again, so many times.

    Returns:
        A line about each time.

    Raises:
        AssertionError: more than a unit was lost, or the result is another.
    """
    verb = Verb(name, folder)
    whole = verb.run(verb.folder / "whole")
    expected = verb.result(verb.folder / "whole")
    assert expected, f"{name}: no result"
    total = _by_file(whole.saved)
    for path, holdings in total.items():
        steps = [later - sooner for sooner, later in zip([0, *holdings], holdings, strict=False)]
        assert set(steps) == {verb.job.unit}, f"{path}: saved {holdings}, not unit by unit"
    rng = random.Random(seed)
    lines = []
    for number in range(times):
        out = verb.folder / f"{number}"
        moment = rng.uniform(0, whole.seconds)
        where = f"{name}, seed {seed}, time {number}, killed after {moment:.2f} s"
        killed = verb.run(out, moment)
        kept = verb.held(out)
        joined = verb.job.saves.count("/") and any(out.glob(verb.job.result))
        for path, holdings in _by_file(killed.saved).items():
            # A line is written a moment before its file takes its place, so the last may tell of
            # one that never did; and parts that were joined are gone.
            least = holdings[-1] - verb.job.unit
            assert joined or kept.get(path, 0) >= least, f"{where}: {path.name} lost {holdings}"
        resumed = verb.run(out)
        for path, holdings in _by_file(resumed.saved).items():
            assert holdings[0] == kept.get(path, 0) + verb.job.unit, (
                f"{where}: {path.name} held {kept.get(path, 0)} and was saved with {holdings} then"
            )
        found = verb.result(out)
        assert found.keys() == expected.keys(), f"{where}: other files"
        for file, content in expected.items():
            other = _difference(content, found[file])
            assert not other, f"{where}: {file} is another than without the stop: {other}"
        units_kept = sum(kept.values())
        units_all = sum(holdings[-1] for holdings in total.values())
        lines.append(f"{where}: {units_kept} of {units_all} kept, same result")
    return lines


def _by_file(saved: list[tuple[Path, int]]) -> dict[Path, list[int]]:
    found: dict[Path, list[int]] = {}
    for path, held in saved:
        found.setdefault(path, []).append(held)
    return found


def _difference(one: Any, other: Any, place: str = "") -> str:
    """Where two contents differ first, and how; empty if they do not."""
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        pairs = [(f"{place}.{name}", one[name], other[name]) for name in one]
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        pairs = [(f"{place}[{n}]", *both) for n, both in enumerate(zip(one, other, strict=True))]
    else:
        shown = (f"{place}: ", f"{one!r:.200}", " / ", f"{other!r:.200}")
        return "" if one == other else "".join(shown)
    return next(filter(None, (_difference(a, b, name) for name, a, b in pairs)), "")


def _timeless(content: Any) -> Any:
    """JSON without what depends on the clock, or on a commit that is made meanwhile."""
    if isinstance(content, dict):
        lasting = {k: v for k, v in content.items() if "seconds" not in k and k != "commit"}
        return {name: _timeless(value) for name, value in lasting.items()}
    if isinstance(content, list):
        return [_timeless(value) for value in content]
    return content


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--verb", choices=JOBS, required=True)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for line in check(options.verb, options.times, options.seed, Path(folder)):
            print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())

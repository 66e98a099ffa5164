"""Open the attacks of a family, one after the other: what came of each, a line of JSON.

python tests/attacks/run.py checkpoints
"""

from __future__ import annotations

import faulthandler
import importlib
import json
import resource
import sys
import tempfile
import time
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

SECONDS = 60
"""An attack that takes longer has won."""
MEMORY = 6 << 30
"""Bytes of address space; torch alone takes some of them."""


def main(family: str) -> None:
    """Write each attack, open it, and say what was raised."""
    attacks = importlib.import_module(f"attacks.{family}")
    warnings.simplefilter("error")
    with tempfile.TemporaryDirectory() as folder:
        paths = {}
        for number, (name, write) in enumerate(attacks.ATTACKS.items()):
            paths[name] = Path(folder, f"attack-{number}.bin")
            write(paths[name])
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        for name, path in paths.items():
            faulthandler.dump_traceback_later(SECONDS, exit=True)
            begin = time.monotonic()
            try:
                attacks.attempt(path)
                kind, words = "", "was opened"
            except BaseException as error:
                kind, words = type(error).__name__, str(error)
            faulthandler.cancel_dump_traceback_later()
            seconds = round(time.monotonic() - begin, 2)
            told = {
                "attack": name,
                "raised": kind,
                "named": path.name in words,
                "words": words[:300],
            }
            print(json.dumps({**told, "seconds": seconds}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])

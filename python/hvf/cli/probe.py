"""``hvf probe``: how well a learned model predicts."""

from __future__ import annotations

from collections.abc import Sequence

import tyro

from hvf.cli.arguments import parsed


def run(words: Sequence[str]) -> None:
    """Errors of a learned model's predictions, by steps ahead, beside "nothing moves".

    Images as PSNR, SSIM and ST-LPIPS (where installed); things as millimetres, by a probe that is
    trained on true frames and states for this alone. Model and domain come from the checkpoint and
    the data. Ctrl-C stops; the same command goes on from there. Models of the maze can be probed in
    any layout, without data:

        hvf probe --layout corridor-4 --model python/hvf/weights/maze_dynamics.safetensors
    """
    from hvf.experiments.prediction import Probe, probe  # torch, which takes a second

    default = Probe(data=None, model=tyro.MISSING)
    settings = {"default": default, "description": run.__doc__}
    probe(parsed(Probe, "probe", words, prefixes=True, **settings))

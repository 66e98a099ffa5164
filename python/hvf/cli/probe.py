"""``hvf probe``: how well a learned model predicts."""

from __future__ import annotations

from collections.abc import Sequence

from hvf.cli.arguments import parsed


def run(words: Sequence[str]) -> None:
    """Errors of a learned model's predictions, by steps ahead, beside "nothing moves".

    Images as PSNR, SSIM and ST-LPIPS (where installed); things as millimetres, by a probe that is
    trained on true frames and states for this alone. Model and domain come from the checkpoint and
    the data. Ctrl-C stops; the same command goes on from there.
    """
    from hvf.experiments.prediction import Probe, probe  # torch, which takes a second

    probe(parsed(Probe, "probe", words, prefixes=True, description=run.__doc__))

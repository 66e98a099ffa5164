"""``hvf probe``: how well a learned model predicts."""

from __future__ import annotations

from typing import Annotated

import tyro

from hvf.experiments import prediction


def probe(config: Annotated[prediction.Probe, tyro.conf.arg(name="")]) -> None:
    """Errors of a learned model's predictions, by steps ahead, beside "nothing moves".

    Images as PSNR, SSIM and ST-LPIPS (where installed); things as millimetres, by a probe that is
    trained on true frames and states for this alone. Model and domain come from the checkpoint and
    the data. Ctrl-C stops; the same command goes on from there.
    """
    prediction.probe(config)

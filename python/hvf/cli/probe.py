"""``hvf probe``: what the learned models predict."""

from __future__ import annotations

from typing import Annotated

import tyro

from hvf.evaluation.prediction import DeskModelProbe, probe_desk


def desk(config: Annotated[DeskModelProbe, tyro.conf.arg(name="")]) -> None:
    """Errors of the learned dynamics of the desk on held-out episodes, 1, 5 and 15 steps ahead.

    Images as PSNR and SSIM; end effector, door, drawer and blocks by a probe that is trained on
    true frames for this alone. Ctrl-C stops; the same command goes on from there.
    """
    probe_desk(config)

"""Recorded video: episodes of any data file, in which nothing can be acted.

The third domain of Nair & Finn (ICLR 2020), section 6.3: subgoals between two frames of a recorded
episode, and what the way over them costs to plan. The box of actions is that of the dynamics.
"""

from __future__ import annotations

import dataclasses

from hvf.domains.domain import Domain, Place
from hvf.settings import Planning, Preset

# BAIR: five actions, each held for three steps.
_PAPER = Planning(horizon=15, action_repeat=3, initial="normal")

VIDEO = Domain(
    name="video",
    about="recorded episodes of any data file, such as of a real robot (paper, section 6.3)",
    open_with=lambda workers: Place(),
    action_low=(),
    action_high=(),
    presets={
        "default": Preset(
            dataclasses.replace(_PAPER, initial="uniform"),
            about="the paper's plans, with actions from all of the dynamics' box first",
        ),
        "paper": Preset(_PAPER, about="as published: five actions of three steps, from N(0, 1)"),
    },
)

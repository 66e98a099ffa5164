"""Acts by a policy, straight to the goal image and without a plan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hvf.agents.direct import DirectAgent
from hvf.protocols import Decision, Images, Indices, Policy


class PolicyAgent(DirectAgent):
    """Acts by a policy that is given a goal image; has no subgoals.

    Args:
        policy: what it acts by.
    """

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy = policy

    def act(
        self, which: Indices, observations: Images, aims: Indices, seeds: Sequence[int]
    ) -> Decision:
        """Return the policy's actions."""
        # One at a time, so that an action does not depend on which trials run beside.
        chosen = [
            self.policy.act(observation, self._goals[trial])
            for trial, observation in zip(map(int, which), observations, strict=True)
        ]
        return Decision(np.stack(chosen).astype(np.float32))

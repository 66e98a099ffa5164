"""RIG: a policy for goal images, learned by reaching for imagined ones (Nair et al., NeurIPS 2018).

Images become latents of a VAE; goals are drawn from its prior; the reward is minus the distance to
the goal in the latent, and the policy is learned by TD3 (Fujimoto et al., 2018). Settings are those
of the authors' code (rlkit, ``examples/rig/pusher/rig.py``, ``rlkit/torch/td3/td3.py``).

All networks take one gradient step together, so the policy follows a critic that has not yet taken
this step; in rlkit the critic steps first. Nothing else of TD3 differs.

Letters in shapes: ``B`` transitions, ``L`` latent dimensions, ``A`` action dimensions.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Mapping
from typing import ClassVar, cast

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn import functional as F

from hvf.action_box import check_action_box
from hvf.models.convolutions import fully_connected
from hvf.models.frames import to_unit
from hvf.models.vae import VAE
from hvf.models.vae_config import RIG_VAE, CVAEConfig

# First weights of the last layers: every action and value begins near 0 (rlkit).
_LAST = 3e-3


@dataclasses.dataclass(frozen=True)
class RIGConfig:
    """Sizes of the networks and settings of TD3; the defaults are rlkit's.

    Attributes:
        vae: of the images.
        action_low: lowest action, ``A`` numbers.
        action_high: highest action.
        layers: widths of the rectified layers of policy and critics.
        discount: of rewards a step later.
        tau: how far target networks go towards the others at a time.
        target_noise: standard deviation of the noise on the target policy's actions, which are
            from -1 to 1.
        noise_clip: that noise is at most so large.
        delay: the policy, and all targets, move at every so many steps.

    Raises:
        ValueError: a number out of range, or a VAE with a scene.
    """

    vae: CVAEConfig = RIG_VAE
    action_low: tuple[float, ...] = (-1.0, -1.0)
    action_high: tuple[float, ...] = (1.0, 1.0)
    layers: tuple[int, ...] = (400, 300)
    discount: float = 0.99
    tau: float = 0.005
    target_noise: float = 0.2
    noise_clip: float = 0.5
    delay: int = 2

    def __post_init__(self) -> None:
        if self.vae.conditional:
            raise ValueError("vae: must not be conditional: a goal is imagined without a scene")
        check_action_box(self.action_low, self.action_high)
        if not self.layers or min(self.layers) < 1:
            raise ValueError(f"layers must be positive, got {self.layers}")
        if not 0 <= self.discount < 1:
            raise ValueError(f"discount must be from 0 to below 1, got {self.discount}")
        if not 0 < self.tau <= 1:
            raise ValueError(f"tau must be above 0 and at most 1, got {self.tau}")
        for name in ("target_noise", "noise_clip"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if self.delay < 1:
            raise ValueError(f"delay must be at least 1, got {self.delay}")


class RIG(nn.Module):
    """VAE, policy, two critics, and the target networks of the three.

    The VAE is not trained here: give it with :meth:`see_with`.
    """

    config_type: ClassVar[type[RIGConfig]] = RIGConfig

    def __init__(self, config: RIGConfig) -> None:
        super().__init__()
        self.config = config
        latent, actions = config.vae.latent_dim, len(config.action_low)
        self.vae = VAE(config.vae).requires_grad_(False)
        self.policy = _network(2 * latent, *config.layers, actions)
        self.critics = nn.ModuleList(
            [_network(2 * latent + actions, *config.layers, 1) for _ in range(2)]
        )
        self.target_policy = copy.deepcopy(self.policy).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)

    def see_with(self, vae: VAE) -> RIG:
        """Take over the weights of a trained ``vae``.

        Raises:
            ValueError: one of another config.
        """
        if vae.config != self.config.vae:
            raise ValueError(f"vae: must have the config {self.config.vae}, has {vae.config}")
        self.vae.load_state_dict(vae.state_dict())
        return self

    def latents(self, frames: Tensor) -> Tensor:
        """Means of the posterior, ``[B, L]``, of ``frames`` uint8 ``[B, H, W, 3]``."""
        return self.vae.encode(to_unit(frames), None)[0]

    def act(self, latent: Tensor, goal: Tensor) -> Tensor:
        """Actions ``[B, A]`` from -1 to 1 at latents ``[B, L]``, towards ``goal [B, L]``."""
        actions: Tensor = torch.tanh(self.policy(torch.cat([latent, goal], 1)))
        return actions

    def in_the_box(self, actions: Tensor) -> Tensor:
        """Actions from -1 to 1 as the environment takes them, ``[..., A]``."""
        low = actions.new_tensor(self.config.action_low)
        high = actions.new_tensor(self.config.action_high)
        return low + (actions + 1) / 2 * (high - low)

    def targets(self, batch: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        """What the critics should say of a batch's actions, ``[B]``.

        The reward, ``-|after - goal|``, and the discounted smaller value of the two target critics
        for the target policy's action with ``noise [B, A]`` on it. No path has an end.
        """
        after, goal = batch["after"], batch["goal"]
        with torch.no_grad():
            seen = torch.cat([after, goal], 1)
            actions = torch.tanh(self.target_policy(seen)) + noise
            both = [critic(torch.cat([seen, actions], 1))[:, 0] for critic in self.target_critics]
            reward: Tensor = -(after - goal).norm(dim=1)
            return reward + self.config.discount * torch.minimum(both[0], both[1])

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Squared errors of both critics, and at every ``delay``-th step minus the policy's value.

        Moves the target networks at the step after one of the policy's, before anything else.

        Args:
            batch: ``latent``, ``after`` and ``goal``, float32 ``[B, L]``, and ``action``, float32
                ``[B, A]`` from -1 to 1.
            generator: of the noise on the target policy's actions.
            step: says whether the policy learns.
        """
        config = self.config
        if step > 0 and (step - 1) % config.delay == 0:
            self._move_targets()
        seen = torch.cat([batch["latent"], batch["goal"]], 1)
        draw = torch.randn(batch["action"].shape, generator=generator, device=seen.device)
        noise = (draw * config.target_noise).clamp(-config.noise_clip, config.noise_clip)
        aims = self.targets(batch, noise)
        done = torch.cat([seen, batch["action"]], 1)
        values = [critic(done)[:, 0] for critic in self.critics]
        error = sum((F.mse_loss(value, aims) for value in values), seen.new_zeros(()))
        parts = {"critics": error.detach(), "value": values[0].detach().mean()}
        if step % config.delay:
            return error, parts
        # The policy's gradient must not reach the critic.
        critic = self.critics[0]
        held = {name: weights.detach() for name, weights in critic.named_parameters()}
        planned = torch.cat([seen, torch.tanh(self.policy(seen))], 1)
        worth = functional_call(critic, held, (planned,)).mean()
        return error - worth, {**parts, "policy": -worth.detach()}

    def _move_targets(self) -> None:
        with torch.no_grad():
            for target, network in (
                (self.target_policy, self.policy),
                (self.target_critics, self.critics),
            ):
                for old, new in zip(target.parameters(), network.parameters(), strict=True):
                    old.lerp_(new, self.config.tau)


def _network(*widths: int) -> nn.Sequential:
    """Fully connected layers; the first weights of the last one are small."""
    network = fully_connected(*widths)
    last = cast(nn.Linear, network[-1])
    nn.init.uniform_(last.weight, -_LAST, _LAST)
    nn.init.uniform_(last.bias, -_LAST, _LAST)
    return network

"""Training the desk's proposals of subgoals: by recorded changes, then by the best proposals."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from hvf.models.checkpoint import load_model
from hvf.models.layers.generator import LayerGenerator
from hvf.models.layers.proposals import LayerProposals, ProposalsConfig
from hvf.training.loop import LoopConfig, Validation, seeded
from hvf.training.recipe import Stage, Stages, TrainingData
from hvf.training.recipes.on_states import OnStates
from hvf.training.tracks.kept import checksum
from hvf.training.tracks.pairs import StatePairs

# Shares of changes in which the hand alone moves, something slides, a part moves, a part is gone:
# goals of tasks hold mostly rare ones.
_SHARES = (0.05, 0.3, 0.25, 0.4)
# Changes that lead to a goal beyond the number of subgoals, at most.
_FAR = 2
# Scenes and goals that validation measures.
_MEASURED = 128


@dataclasses.dataclass(frozen=True, kw_only=True)
class LayersProposalsRecipe(OnStates):
    """Training of the proposals.

    Attributes:
        generator: trained generator of states (``hvf train layers-generator``).
        hindsight_steps: the first steps, that learn from recorded changes; the others follow the
            best proposals.
        searched: scenes with goals per step of these.
        model: the network; the sizes of its generator are the generator's.
        loop: how to optimise.
    """

    name: ClassVar[str] = "layers-proposals"

    batch_size: int = 256
    generator: Path = Path("runs/layers-generator/model.safetensors")
    hindsight_steps: int = 6000
    searched: int = 16
    model: ProposalsConfig = ProposalsConfig()
    loop: LoopConfig = LoopConfig(
        steps=7500,
        learning_rate=1e-3,
        schedule="cosine",
        warmup_steps=100,
        clip_norm=5.0,
        precision="float32",
        validate_every=2000,
        checkpoint_every=1000,
        threads=1,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.at_least_one("searched")
        if self.hindsight_steps < 0:
            raise ValueError(f"hindsight_steps must not be negative, got {self.hindsight_steps}")

    def stages(self, data: TrainingData) -> Stages:
        """One stage, in two parts: hindsight, then the best proposals."""
        seed = self.loop.seed
        dynamics = self.seeing(data)
        generator = load_model(self.generator, LayerGenerator, environment=data.environment)
        found, expected = generator.config.state_size, dynamics.config.perception.state_size
        if found != expected:
            raise ValueError(f"generator: draws states of length {found}, the dynamics' {expected}")
        config = dataclasses.replace(self.model, generator=generator.config)
        changes = Recombined(
            StatePairs(self.tracks(data, dynamics), self.batch_size, seed, _SHARES),
            generator,
            config.most,
            self.hindsight_steps,
            self.searched,
            seed,
        )
        measured = Recombined(
            StatePairs(self.held_out(data, dynamics), _MEASURED, seed, _SHARES),
            generator,
            config.most,
            0,
            _MEASURED,
            seed,
        )
        yield Stage(
            seeded(seed, lambda: LayerProposals(config)).learn_for(generator),
            changes,
            self.loop,
            "proposals: which change comes next on the way to a goal",
            settings={
                **self.settings(dynamics),
                "generator": checksum(generator),
                "hindsight_steps": self.hindsight_steps,
                "searched": self.searched,
            },
            validate=lambda model, _: validate_proposals(model, measured),
        )


class Recombined:
    """Scenes, and goals that several recorded changes lead to, one after the other.

    Two stretches of one episode seldom change two things that rarely change; goals of tasks do.
    So changes of several episodes, rare and common (:class:`StatePairs`), are carried over into one
    scene: the latent that the generator's posterior has of a change, drawn in the scene that the
    change before it left. Each is a subgoal that was passed on the way, with its latent.

    A batch has one number of subgoals, K, 1 to ``most`` in turns. For the first
    ``hindsight_steps`` steps K + 1 changes lead to the goal, and it holds ``path``
    ``[N, K + 2, X]`` and ``latents`` ``[N, K, L]``; then up to :data:`_FAR` more do, so that there
    are goals farther than those of tasks, and it holds ``path`` and ``count``, K.

    Args:
        pairs: scenes and what they are later.
        generator: knows the latents of changes, and draws.
        most: most subgoals.
        hindsight_steps: see above.
        searched: samples of the batches after these, at most as many as the pairs'.
        seed: of the draws.
    """

    def __init__(
        self,
        pairs: StatePairs,
        generator: LayerGenerator,
        most: int,
        hindsight_steps: int,
        searched: int,
        seed: int,
    ) -> None:
        self._pairs, self._most = pairs, most
        self._generator = generator.eval().requires_grad_(False)
        self._hindsight_steps, self._searched = hindsight_steps, searched
        self._seed = seed

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step)."""
        count = 1 + step % self._most
        hindsight = step < self._hindsight_steps
        changes = count + 1 + (0 if hindsight else step // self._most % (_FAR + 1))
        random = torch.Generator().manual_seed(
            int(np.random.SeedSequence([self._seed, step]).generate_state(1)[0])
        )
        path: list[torch.Tensor] = []
        latents: list[torch.Tensor] = []
        with torch.no_grad():
            for k in range(changes):
                # Other pairs for each change: batches of steps of their own.
                pairs = self._pairs.batch(step * (self._most + 1 + _FAR) + k)
                if not path:
                    path.append(pairs["scenes"])
                mean, log_variance = self._generator.encode(pairs["states"], pairs["scenes"])
                noise = torch.randn(mean.shape, generator=random)
                latents.append(mean + (0.5 * log_variance).exp() * noise)
                path.append(self._generator.decode(latents[-1], path[-1]))
        found = {"path": torch.stack(path, dim=1)}
        if hindsight:
            return {**found, "latents": torch.stack(latents[:-1], dim=1)}
        return {"path": found["path"][: self._searched], "count": torch.tensor(count)}


def validate_proposals(model: LayerProposals, changes: Recombined) -> Validation:
    """The hardest segment, nats (median), of means and of draws, by the number of subgoals.

    Beside that of the changes that the goals are made of.
    """
    metrics: dict[str, float] = {}
    random = torch.Generator().manual_seed(0)
    for step in range(model.config.most):
        batch = changes.batch(step)
        path, count = batch["path"], int(batch["count"])
        shape = (len(path), model.config.draws, count, model.config.generator.latent_dim)
        noises = {
            "means": torch.zeros(len(path), model.config.elites, *shape[2:]),
            "best": torch.randn(shape, generator=random),
        }
        for name, noise in noises.items():
            costs = model.best(path[:, 0], path[:, -1], noise)[2]
            best = costs.reshape(len(path), -1)[:, 0]
            metrics[f"{name}_{count}"] = float(best.median())
        metrics[f"changes_{count}"] = float(model.costs(path).median())
    return Validation(metrics)

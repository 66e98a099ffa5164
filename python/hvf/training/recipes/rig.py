"""Training of RIG: a VAE of recorded images, then a policy by acting in the domain they are of."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.data.splits import EPISODE_SEEDS
from hvf.domains.domain import Domain
from hvf.models.rig import RIG, RIGConfig
from hvf.models.vae_config import RIG_VAE, CVAEConfig
from hvf.protocols import Trials
from hvf.registry import DOMAINS
from hvf.training.exploring import Exploration, Explorer
from hvf.training.loop import LoopConfig, Validation, seeded
from hvf.training.recipe import Recipe, Stage, Stages, TrainingData
from hvf.training.recipes.vae import VAERecipe
from hvf.training.replay import Relabelling

# Validation episodes that a validation acts in.
_EPISODES = 20
_PAPER_VAE = VAERecipe.presets["rig"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RIGRecipe(Recipe):
    """Training of RIG (Nair et al., NeurIPS 2018).

    The VAE learns from the file; the policy learns by acting in episodes of the train split of a
    domain, towards goals imagined by the VAE. Preset ``paper`` is as in rlkit's
    ``examples/rig/pusher/rig.py``: one trial at a time, paths of 100 steps, 505,000 steps with 4
    updates each, and the VAE's preset ``rig`` (the convolutions are ours). The default is what two
    cores can pay, in episodes of the domain's length, random at first, with 16 trials side by side
    and the losses that our generators learn with in few steps; the relabelling and TD3 are rlkit's.

    Attributes:
        domain: where to act; the one that the data is of, if none.
        task: which of its tasks to begin in; all, in turns, if none.
        batch_size: transitions of an update.
        exploration: how to act while learning.
        relabelling: whose goals the transitions of a batch are given.
        vae: of the images; their size is the data's.
        vae_batch: images per step of the VAE.
        vae_loop: how to optimise the VAE.
        memory_gb: memory for decoded frames.
        model: policy and critics; its VAE and its actions are filled in.
        loop: how to optimise policy and critics; a step is an update.
    """

    name: ClassVar[str] = "rig"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {
            "exploration": Exploration(),
            "vae": _PAPER_VAE["model"],
            "vae_batch": _PAPER_VAE["batch_size"],
            "vae_loop": _PAPER_VAE["loop"],
            "loop.steps": 2_020_000,
        }
    }

    domain: str | None = None
    task: str | None = None
    batch_size: int = 128
    exploration: Exploration = Exploration(trials=16, path_steps=None, uniform_before=True)
    relabelling: Relabelling = Relabelling()
    vae: CVAEConfig = dataclasses.replace(
        RIG_VAE, centred=True, pyramid_levels=4, pyramid_weight=1.0
    )
    vae_batch: int = 32
    vae_loop: LoopConfig = LoopConfig(
        steps=6_000, learning_rate=1e-3, warmup_steps=200, schedule="cosine"
    )
    memory_gb: float = 2.0
    model: RIGConfig = RIGConfig()
    loop: LoopConfig = LoopConfig(
        steps=100_000,
        learning_rate=1e-3,
        precision="float32",
        validate_every=10_000,
        checkpoint_every=5_000,
        threads=1,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.at_least_one("batch_size", "vae_batch")
        self.positive("memory_gb")

    def stages(self, data: TrainingData) -> Stages:
        """The VAE from recorded images, then the policy by acting."""
        domain, tasks = self._where(data)
        seeing = VAERecipe(
            data=self.data,
            camera=self.camera,
            batch_size=self.vae_batch,
            memory_gb=self.memory_gb,
            model=self.vae,
            loop=dataclasses.replace(self.vae_loop, seed=self.loop.seed),
        )
        vae = yield dataclasses.replace(
            seeing.stage(data), about="vae: images that are possible", folder="vae"
        )
        config = dataclasses.replace(
            self.model,
            vae=vae.config,
            action_low=tuple(map(float, domain.action_low)),
            action_high=tuple(map(float, domain.action_high)),
        )
        model = seeded(self.loop.seed, lambda: RIG(config)).see_with(vae.cpu())
        with domain.open() as place:
            seen = place.trials(tasks[0][0], EPISODE_SEEDS["train"], 0, 1).goals.shape[1:3]
            if seen != data.image_size:
                raise ValueError(
                    f"{data.path}: has images of {data.image_size}, {domain.name} of {seen}"
                )
            explorer = Explorer(
                model,
                place,
                tasks,
                self.exploration,
                self.relabelling,
                self.batch_size,
                self.loop.seed,
                EPISODE_SEEDS["train"],
            )
            yield Stage(
                model,
                explorer,
                self.loop,
                f"policy: acting in the {domain.name}",
                settings={
                    "domain": domain.name,
                    "tasks": [list(each) for each in tasks],
                    "batch_size": self.batch_size,
                    "exploration": dataclasses.asdict(self.exploration),
                    "relabelling": dataclasses.asdict(self.relabelling),
                    "vae_batch": self.vae_batch,
                    "vae_steps": self.vae_loop.steps,
                },
                validate=lambda trained, _: validate_rig(trained, domain, tasks),
            )

    def _where(self, data: TrainingData) -> tuple[Domain, list[tuple[str, int]]]:
        """The domain, and the tasks to take turns with the steps of their paths.

        Raises:
            ValueError: none, another task, or a domain with other actions than the data's.
        """
        name = data.environment if self.domain is None else self.domain
        if name not in DOMAINS:
            known = ", ".join(DOMAINS)
            raise ValueError(
                f"domain: a policy learns by acting, and {name!r} is none of {known}; name one"
            )
        domain = DOMAINS[name]
        task = domain.default_task if self.task is None else self.task
        domain.check_task(task)
        if len(domain.action_low) != data.action_dim:
            raise ValueError(
                f"domain: {name} has {len(domain.action_low)} action dimensions, the data has "
                f"{data.action_dim}"
            )
        chosen = list(domain.tasks) if self.task is None else [task]
        own = self.exploration.path_steps
        return domain, [(each, own or domain.steps(each)) for each in chosen]


def validate_rig(model: RIG, domain: Domain, tasks: list[tuple[str, int]]) -> Validation:
    """Act towards true goal images, in the first validation episodes of every task.

    In a place of its own: one may have no more than one set of trials at a time.

    Returns:
        The part of episodes that reach their goal, and how far from it in the latent they end, as
        a part of how far they began (median); by task.
    """
    metrics = {}
    with domain.open() as place:
        for task, _ in tasks:
            trials = place.trials(task, EPISODE_SEEDS["validation"], 0, _EPISODES)
            reached, left = _acted_out(model, trials, domain.steps(task))
            metrics[f"reached_{task}"] = float(reached.mean())
            metrics[f"latent_left_{task}"] = float(left.median())
    return Validation(metrics)


def _acted_out(model: RIG, trials: Trials, steps: int) -> tuple[NDArray[np.bool_], torch.Tensor]:
    """Which trials reach their goals, and what is left of the distance in the latent, ``[N]``."""
    device = next(model.parameters()).device
    goals = model.latents(torch.from_numpy(trials.goals).to(device))
    alive, reached = np.arange(len(trials)), np.zeros(len(trials), bool)
    now = torch.zeros_like(goals)
    far: list[torch.Tensor] = []
    for _ in range(steps):
        images = torch.from_numpy(np.ascontiguousarray(trials.observe(alive)))
        now[alive] = model.latents(images.to(device))
        far.append((now - goals).norm(dim=1))
        actions = model.in_the_box(model.act(now[alive], goals[alive])).cpu().numpy()
        broken = trials.step(alive, actions)
        alive = np.array([trial for trial in alive if int(trial) not in broken], np.int64)
        reached[alive] = trials.success(alive)
        alive = alive[~reached[alive]]
        if not len(alive):
            break
    return reached, far[-1] / far[0]

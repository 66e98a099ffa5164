"""The training loop, one for all models.

A step is: draw the batch of that step, ask the model for its loss, follow the gradient. The batch
and all noise are functions of (seed, step) alone, so a run that was killed and resumed from its
last checkpoint does the same steps as one that was not.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from rich.console import Console

from hvf.interrupts import Interrupts
from hvf.models.checkpoint import read_header, save_model
from hvf.models.config import config_to_json
from hvf.training.report import Reporter, Validation
from hvf.training.state import Memory, TrainingState, load_state, save_state

__all__ = [
    "Batch",
    "Interactive",
    "LoopConfig",
    "Sampler",
    "Trainable",
    "Validation",
    "seeded",
    "step_seed",
    "train",
]

Batch = Mapping[str, torch.Tensor]


class Sampler(Protocol):
    """Where batches come from."""

    def batch(self, step: int) -> Batch:
        """The batch of training step ``step``: CPU tensors, a function of ``step`` alone.

        Called from one background thread, one batch ahead.
        """
        ...


@runtime_checkable
class Interactive(Sampler, Memory, Protocol):
    """A sampler whose batches depend on the model in training, such as one that acts by it.

    :meth:`Sampler.batch` is called between steps, in order, and not ahead. What it goes on from is
    kept with the run.
    """


class Trainable(Protocol):
    """What the loop asks of a ``torch.nn.Module``."""

    @property
    def config(self) -> Any:
        """The frozen dataclass the model was built from."""
        ...

    def loss(
        self, batch: Batch, generator: torch.Generator, step: int
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Loss of one batch (scalar, with gradient) and scalars to report (without).

        Args:
            batch: what the sampler gave, on the model's device.
            generator: the source of all noise in the loss, on the model's device, seeded by
                (seed, step); the global generator must not be used.
            step: number of the step, from 0, for schedules of weights.
        """
        ...


@dataclasses.dataclass(frozen=True)
class LoopConfig:
    """How to optimise, how often to report, and where.

    Attributes:
        steps: gradient steps in all.
        learning_rate: of Adam, at its highest.
        schedule: of the learning rate after the warm-up: constant, or half a cosine down to 0.
        warmup_steps: steps over which the learning rate rises linearly from 0.
        weight_decay: decoupled (AdamW) if positive.
        clip_norm: gradients are scaled down to this L2 norm; 0 for no limit.
        betas: decay of Adam's running means of gradients and of their squares.
        eps: Adam's, added to the root of the latter.
        seed: of the weights, the batches and the noise.
        device: ``auto`` takes CUDA where there is one.
        precision: ``auto`` is bfloat16 autocast on CUDA and float32 on the CPU.
        channels_last: keep convolution weights in that memory order (faster on both).
        threads: torch's CPU threads; 0 leaves them as they are.
        log_every: steps between entries in TensorBoard.
        validate_every: steps between validations; the last step always validates.
        checkpoint_every: steps between checkpoints; the last step always writes one.
    """

    steps: int = 10_000
    learning_rate: float = 1e-4
    schedule: Literal["constant", "cosine"] = "constant"
    warmup_steps: int = 0
    weight_decay: float = 0.0
    clip_norm: float = 0.0
    betas: tuple[float, float] = (0.9, 0.999)
    eps: float = 1e-8
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    channels_last: bool = True
    threads: int = 0
    log_every: int = 50
    validate_every: int = 1_000
    checkpoint_every: int = 500

    def __post_init__(self) -> None:
        for name in ("steps", "log_every", "validate_every", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("warmup_steps", "weight_decay", "clip_norm", "seed", "threads"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if not (math.isfinite(self.learning_rate) and self.learning_rate > 0):
            raise ValueError(f"learning_rate must be positive, got {self.learning_rate}")
        if len(self.betas) != 2 or not all(0 <= beta < 1 for beta in self.betas):
            raise ValueError(f"betas must be two numbers from 0 to below 1, got {self.betas}")
        if not (math.isfinite(self.eps) and self.eps > 0):
            raise ValueError(f"eps must be positive, got {self.eps}")

    def rate(self, step: int) -> float:
        """The learning rate at ``step``."""
        if step < self.warmup_steps:
            return self.learning_rate * (step + 1) / self.warmup_steps
        if self.schedule == "constant":
            return self.learning_rate
        done = (step - self.warmup_steps) / max(1, self.steps - self.warmup_steps)
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * min(1.0, done)))

    def torch_device(self) -> torch.device:
        """The device to train on.

        Raises:
            ValueError: CUDA is asked for and not there.
        """
        if self.device == "cuda" and not torch.cuda.is_available():
            raise ValueError("device: cuda was asked for, but torch finds no CUDA device")
        if self.device == "auto":
            return torch.device("cuda" if torch.cuda.is_available() else "cpu")
        return torch.device(self.device)


# May differ between the run that wrote a checkpoint and the one that resumes it: they change what
# is reported and when, not what is computed.
_FREE_ON_RESUME = ("device", "threads", "log_every", "validate_every", "checkpoint_every")
# Settings that came later go without saying where they are what had gone without saying: runs of
# before are still the same runs.
_UNSAID = {"betas": (0.9, 0.999), "eps": 1e-8}

ModelT = TypeVar("ModelT", bound=torch.nn.Module)


def seeded(seed: int, build: Callable[[], ModelT]) -> ModelT:
    """Call ``build`` with torch's global generator seeded, and put the generator back after."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return build()


def train(
    model: ModelT,
    sampler: Sampler,
    config: LoopConfig,
    out: str | Path,
    *,
    environment: str,
    run: Mapping[str, Any] | None = None,
    validate: Callable[[ModelT, torch.Generator], Validation] | None = None,
    console: Console | None = None,
) -> ModelT:
    """Train ``model``, or go on with the run that ``out`` holds.

    ``out`` gets ``model.safetensors`` (weights and config, for use), ``training.safetensors`` (the
    same with the optimiser, to resume), TensorBoard's events, and ``pictures/``. Ctrl-C or SIGTERM
    finishes the step, writes both files and raises KeyboardInterrupt; the same call goes on.

    The weights are written before the state: whoever is killed in between has weights that are
    ahead of the state, which the next call makes again, and never a finished state without them.

    Args:
        model: a :class:`Trainable` module, freshly made with ``config.seed`` (:func:`seeded`).
        sampler: where the batches come from.
        config: how to train.
        out: directory of the run.
        environment: name of the environment the data comes from, kept in the checkpoint.
        run: what else identifies the run (command, data), kept in the checkpoint; a run in ``out``
            with another description is refused.
        validate: measures the model on held-out data, in evaluation mode and without gradient;
            its generator is seeded the same every time.
        console: where progress goes.

    Returns:
        ``model``, trained, in evaluation mode.

    Raises:
        ValueError: ``out`` holds another run or a damaged one, or CUDA is missing.
        RuntimeError: the loss is NaN or infinite.
        OSError: a checkpoint cannot be written.
        KeyboardInterrupt: stopped; ``out`` can be resumed.
    """
    console = console or Console()
    out = Path(out)
    device = config.torch_device()
    identity = _identity(model, config, environment, run)
    model = model.to(device)
    if config.channels_last:
        model = model.to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(
        [weights for weights in model.parameters() if weights.requires_grad],
        lr=config.learning_rate,
        betas=config.betas,
        eps=config.eps,
        weight_decay=config.weight_decay,
        fused=True,
    )
    state = TrainingState(model, optimiser, sampler if isinstance(sampler, Interactive) else None)
    first = load_state(out / "training.safetensors", state, identity)
    if first >= config.steps:
        console.print(f"{out}: already trained for {first} steps")
        if _weights_are_behind(out / "model.safetensors", first):
            measured = _finite(_validate(validate, model, config, device)) if validate else {}
            _save_weights(out, model, identity, first, measured)
        return model.eval()
    if first:
        console.print(f"{out}: resuming at step {first}")

    with (
        _threads(config.threads),
        Interrupts() as interrupts,
        Reporter(out, config.steps, first, console) as report,
        _Prefetch(sampler, first, config.steps) as batches,
    ):
        generator = torch.Generator(device)
        metrics: dict[str, float] = {}
        for step in range(first, config.steps):
            loss, parts = _step(model, optimiser, batches.take(step), generator, config, step)
            done = step + 1
            stop = interrupts.asked and done < config.steps
            last = stop or done == config.steps
            if done % config.log_every == 0 or last or done == first + 1:
                report.training(done, loss, {**parts, "learning_rate": config.rate(step)})
            if validate and (done % config.validate_every == 0 or done == config.steps):
                report.validating()
                found = _validate(validate, model, config, device)
                metrics = _finite(found)
                report.validation(done, found)
            if done % config.checkpoint_every == 0 or last:
                if not math.isfinite(loss.item()):
                    raise RuntimeError(f"loss is {loss.item()} at step {step}; nothing was saved")
                _save_weights(out, model, identity, done, metrics)
                save_state(out / "training.safetensors", state, identity, done)
            if stop:
                console.print(f"{out}: stopped at step {done}; the same command goes on from there")
                raise KeyboardInterrupt
    return model.eval()


def step_seed(seed: int, step: int) -> int:
    """Seed of the noise of one step: (seed, step) mixed to 63 bits."""
    return int(np.random.SeedSequence([seed, step]).generate_state(1, np.uint64)[0] >> np.uint64(1))


def _step(
    model: torch.nn.Module,
    optimiser: torch.optim.Optimizer,
    batch: Batch,
    generator: torch.Generator,
    config: LoopConfig,
    step: int,
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """One gradient step; its loss and metrics, detached."""
    model.train()
    device = generator.device
    generator.manual_seed(step_seed(config.seed, step))
    batch = {name: tensor.to(device, non_blocking=True) for name, tensor in batch.items()}
    for group in optimiser.param_groups:
        group["lr"] = config.rate(step)
    optimiser.zero_grad(set_to_none=True)
    with _autocast(config, device):
        loss, parts = model.loss(batch, generator, step)  # type: ignore[operator]
    loss.backward()
    if config.clip_norm > 0:
        parts["gradient_norm"] = torch.nn.utils.clip_grad_norm_(
            model.parameters(), config.clip_norm
        )
    optimiser.step()
    return loss.detach(), parts


def _validate(
    validate: Callable[[Any, torch.Generator], Validation],
    model: torch.nn.Module,
    config: LoopConfig,
    device: torch.device,
) -> Validation:
    generator = torch.Generator(device).manual_seed(step_seed(config.seed, config.steps))
    model.eval()
    with torch.inference_mode(), _autocast(config, device):
        return validate(model, generator)


def _finite(found: Validation) -> dict[str, float]:
    """Metrics that are numbers: JSON has no NaN, and the mean over nothing is none."""
    numbers = {name: float(value) for name, value in found.metrics.items()}
    return {name: value for name, value in numbers.items() if math.isfinite(value)}


def _save_weights(
    out: Path,
    model: torch.nn.Module,
    identity: Mapping[str, Any],
    step: int,
    metrics: Mapping[str, float],
) -> None:
    save_model(
        out / "model.safetensors",
        model,
        environment=identity["environment"],
        training={**identity["run"], "step": step, "validation": dict(metrics)},
    )


def _weights_are_behind(path: Path, step: int) -> bool:
    """Whether the weights of a run that has done ``step`` steps are missing, damaged or older."""
    try:
        return bool(read_header(path).training.get("step") != step)
    except (FileNotFoundError, ValueError):
        return True


def _autocast(config: LoopConfig, device: torch.device) -> torch.autocast:
    wanted = config.precision == "bfloat16" or (
        config.precision == "auto" and device.type == "cuda"
    )
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=wanted)


def _identity(
    model: torch.nn.Module, config: LoopConfig, environment: str, run: Mapping[str, Any] | None
) -> dict[str, Any]:
    """What must be equal for a run to be the continuation of another."""
    fixed = {
        name: value
        for name, value in dataclasses.asdict(config).items()
        if name not in _FREE_ON_RESUME and not (name in _UNSAID and value == _UNSAID[name])
    }
    identity = {
        "model": type(model).__name__,
        "config": config_to_json(model),
        "environment": environment,
        "run": {**(run or {}), "loop": fixed},
    }
    parsed: dict[str, Any] = json.loads(json.dumps(identity, allow_nan=False))
    return parsed


@contextlib.contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    if count:
        torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class _Prefetch:
    """Draws the next batch in a thread while the model works on this one, if it may."""

    def __init__(self, sampler: Sampler, first: int, steps: int) -> None:
        self._sampler = sampler
        self._steps = steps
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="batches")
        self._next: Future[Batch] | None = None
        if not isinstance(sampler, Interactive):
            self._next = self._pool.submit(sampler.batch, first)

    def __enter__(self) -> _Prefetch:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def take(self, step: int) -> Batch:
        if self._next is None:
            return self._sampler.batch(step)
        batch = self._next.result()
        if step + 1 < self._steps:
            self._next = self._pool.submit(self._sampler.batch, step + 1)
        return batch

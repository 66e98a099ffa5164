"""Where and how torch rolls dynamics out, from a domain's settings: device, precision, memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import hvf
import hvf_core
from drifting import models
from hvf.evaluation import Evaluation
from hvf.models.checkpoint import save_model
from hvf.models.sv2p import SV2P, SV2PConfig, SV2PSmall
from hvf.registry import MODELS
from hvf.worlds.video import VideoWorld


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """What tests register is there for them only."""
    monkeypatch.setattr(MODELS, "_targets", dict(MODELS._targets))


def test_worlds_of_a_domain_run_as_their_settings_say(tmp_path: Path) -> None:
    torch.manual_seed(0)
    file = str(tmp_path / "model.safetensors")
    config = SV2PConfig(action_low=(-3.0, -3.0), action_high=(3.0, 3.0))
    save_model(tmp_path / "model.safetensors", SV2PSmall(config), environment="maze")
    cheap = {"dynamics": file, "method": "none", "horizon": 2, "device": "cpu"}
    env = hvf_core.maze_collect(3, 0, 2, 1)[0][:, 0]
    actions = np.random.default_rng(0).uniform(-3, 3, (1, 6, 2, 2)).astype(np.float32)

    def costs(**settings: Any) -> tuple[VideoWorld, NDArray[np.float32]]:
        world, _ = hvf.load("maze", dynamics=file, device="cpu", horizon=2, **settings)
        assert isinstance(world, VideoWorld)
        start, goal = (world.observe(env[n][None]) for n in range(2))
        return world, world.rollout_costs(start, goal, actions, seeds=np.arange(6)[None])

    usual, expected = costs()
    assert usual.rollouts.most > 1
    small, found = costs(memory_gb=1e-6)
    assert small.rollouts.most == 1
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    _, half = costs(precision="bfloat16")
    assert (half != expected).any()
    np.testing.assert_allclose(half, expected, rtol=0.1)
    # Told where it is not as usual, and nowhere else.
    plain = Evaluation.of("maze", **{**cheap, "device": None})
    own = Evaluation.of("maze", **{**cheap, "precision": "bfloat16", "memory_gb": 0.5})
    assert plain.world_names == {"dynamics": file, "cost": "pixel"}
    more = {"device": "cpu", "precision": "bfloat16", "memory_gb": "0.5"}
    assert own.world_names == {**plain.world_names, **more}
    assert own.slug == plain.slug.replace(
        "-horizon-2", "-device-cpu-precision-bfloat16-memory-gb-0.5-horizon-2"
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"precision": "float64"}, "^precision: must be one of auto, float32, bfloat16"),
        ({"memory_gb": 0.0}, "^memory_gb: must be positive and finite, got 0.0"),
        ({"memory_gb": float("inf")}, "^memory_gb: "),
        ({"precision": "bfloat16"}, "^precision: for dynamics that torch rolls out, .* keypoint"),
        ({"device": "cpu", "compile": True, "dynamics": "simulator"}, "^device, compile: for dyna"),
        ({"dynamics": "FILE", "device": "abacus"}, "^device: 'abacus' is none that torch knows"),
    ],
)
def test_settings_of_what_is_rolled_out_are_checked(
    settings: dict[str, Any], message: str, tmp_path: Path
) -> None:
    if settings.get("dynamics") == "FILE":
        settings = {**settings, "dynamics": models(tmp_path)[0]}
    with pytest.raises(ValueError, match=message):
        hvf.load("maze", **settings)


@pytest.mark.skipif(torch.cuda.is_available(), reason="a CUDA device is there")
def test_a_device_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"^device: there is no CUDA here, got 'cuda:0'"):
        hvf.load("maze", dynamics=models(tmp_path)[0], device="cuda:0")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_of_24_gb_is_filled_and_not_overfilled(tmp_path: Path) -> None:
    if torch.cuda.mem_get_info()[0] < 26e9:
        pytest.skip("less than 26 GB of memory are free")
    torch.manual_seed(0)
    file = str(tmp_path / "model.safetensors")
    config = SV2PConfig(action_low=(-3.0, -3.0), action_high=(3.0, 3.0))
    save_model(tmp_path / "model.safetensors", SV2P(config), environment="maze")
    world, _ = hvf.load("maze", dynamics=file, device="cuda", memory_gb=24)
    assert isinstance(world, VideoWorld)
    count = 2 * world.rollouts.most
    env = hvf_core.maze_collect(3, 0, 2, 1)[0][:, 0]
    start, goal = (world.observe(env[n][None]) for n in range(2))
    starts, goals = world.prepare(start, goal)
    torch.cuda.reset_peak_memory_stats()
    actions = np.zeros((1, count, 3, 2), np.float32)
    world.rollout_costs(starts, goals, actions, seeds=np.arange(count)[None])
    assert 10e9 < torch.cuda.max_memory_allocated() <= 24e9

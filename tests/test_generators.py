"""Which generator and distance go with dynamics from a file: those of the model that it holds."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from hvf.domains.domain import Domain
from hvf.evaluation import Evaluation
from hvf.models.checkpoint import save_model
from hvf.models.spatial import SpatialConfig, SpatialLatent
from hvf.models.sv2p import SV2PConfig, SV2PSmall
from hvf.registry import DOMAINS
from hvf.settings import Planning, World
from hvf.worlds.images import ImageSubgoals
from hvf.worlds.load import load, segment_model

BOX = {"action_low": (-3.0, -3.0), "action_high": (3.0, 3.0)}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Checkpoints of one's own, by the model that each holds."""
    folder = tmp_path_factory.mktemp("files")
    torch.manual_seed(0)
    own: dict[str, Any] = {
        "spatial-latent": SpatialLatent(SpatialConfig(widths=(4, 6), known=8, **BOX)),
        "sv2p-small": SV2PSmall(SV2PConfig(**BOX)),
    }
    for name, model in own.items():
        save_model(folder / f"my-{name}.safetensors", model, environment="maze")
    for name in ("keypoint", "latent", "cvae"):
        shutil.copy(DOMAINS["maze"].weights[name], folder / f"my-{name}.safetensors")
    (folder / "my-broken.safetensors").write_bytes(b"no weights")
    return {path.stem.removeprefix("my-"): str(path) for path in folder.iterdir()}


@pytest.mark.parametrize(
    ("model", "generator"),
    [
        ("latent", "cvae"),
        ("spatial-latent", "cvae"),
        ("sv2p-small", "cvae"),
        ("keypoint", "keypoint-generator"),
    ],
)
def test_dynamics_from_a_file_find_the_generator_of_their_model(
    model: str, generator: str, files: dict[str, str]
) -> None:
    domain, world = DOMAINS["maze"], World(files[model])
    assert domain.resolved(world).generator == generator
    with domain.open() as place:
        loaded = load(domain, world, Planning(), place)
    assert {part: each.model for part, each in loaded.weights.items()} == {
        "dynamics": model,
        "generator": generator,
    }
    assert isinstance(loaded.generator, ImageSubgoals) == (generator == "cvae")
    evaluation = Evaluation.of("maze", method="hvf", dynamics=files[model])
    assert evaluation.world_names["generator"] == generator
    # Which generator it is was never said, and is told.
    assert evaluation.name == f"maze hard: HVF-2, my-{model} ({generator})"
    named = Evaluation.of("maze", method="hvf", dynamics=files[model], generator=generator)
    assert named.name == evaluation.name


def test_what_is_said_counts_and_what_nothing_goes_with_is_asked_for(
    files: dict[str, str], tmp_path: Path
) -> None:
    domain = DOMAINS["maze"]
    said = World(files["latent"], files["cvae"])
    assert domain.resolved(said).generator == files["cvae"]
    # No dynamics, no file of weights, no file at all: loading says what is wrong with it.
    for name in (files["cvae"], files["broken"], str(tmp_path / "nowhere.safetensors")):
        assert domain.resolved(World(name)).generator == "default"
    bare = Domain("bare", "nothing ships", domain.open_with, (-1.0,), (1.0,))
    with (
        bare.open() as place,
        pytest.raises(FileNotFoundError, match="generator: name one for this world; none goes"),
    ):
        load(bare, World(files["latent"]), Planning(), place)


def test_names_of_a_domain_stand_for_what_their_files_hold(files: dict[str, str]) -> None:
    maze = DOMAINS["maze"]
    weights = {"dim": Path(files["latent"]), "cvae": maze.weights["cvae"]}
    own = Domain(
        "own", "", maze.open_with, (-1.0,), (1.0,), weights=weights, video_generator="cvae"
    )
    assert (own.model_of("dim"), own.resolved(World("dim")).generator) == ("latent", "cvae")
    assert DOMAINS["desk"].video_generator == "cvae"


def test_segments_of_dynamics_from_a_file_cost_the_distance_of_their_model(
    files: dict[str, str],
) -> None:
    domain, planning = DOMAINS["maze"], Planning(segment_cost="distance")
    assert segment_model(domain, World(files["keypoint"])) == "temporal-distance"
    with domain.open() as place:
        loaded = load(domain, World(files["keypoint"]), planning, place)
    assert loaded.weights["segment"].model == "temporal-distance"
    with pytest.raises(ValueError, match=r"segment_model: name one for .* none goes with"):
        segment_model(domain, World(files["latent"]))

"""The models of this package, as :data:`hvf.registry.MODELS` lists them.

Importing this imports no torch. Object models are fast on a CPU because they know what one scene
is made of; what each takes for granted is its ``assumes``.
"""

from __future__ import annotations

from hvf.models.entry import ModelEntry

KEYPOINT = ModelEntry(
    about="Dynamics of one moving thing before a still scene (the maze).",
    kind="object",
    role="dynamics",
    module="hvf.models.keypoint.dynamics:KeypointDynamics",
    plannable="hvf.worlds.keypoint:world_of",
    recipe="hvf.training.recipes.keypoint:KeypointRecipe",
    assumes=(
        "exactly one thing moves: an upright box of one colour that never turns, scales or hides; "
        "the camera, the light and all else stand still; a move depends on a grey patch of 14 "
        "pixels around it alone"
    ),
)

KEYPOINT_GENERATOR = ModelEntry(
    about="Generator of subgoals that draws where the keypoint dynamics' moving thing may be.",
    kind="object",
    role="generator",
    module="hvf.models.keypoint.generator:KeypointGenerator",
    plannable="hvf.worlds.keypoint:subgoals_of",
    recipe="hvf.training.recipes.keypoint_generator:KeypointGeneratorRecipe",
    assumes="what the keypoint dynamics assumes, which it draws with",
)

TEMPORAL_DISTANCE = ModelEntry(
    about="Classifier of the steps between two frames, a planning cost for the keypoint dynamics.",
    kind="object",
    role="distance",
    module="hvf.models.temporal_distance:TemporalDistance",
    plannable="hvf.worlds.steps:keypoint_steps",
    judge="hvf.worlds.steps:keypoint_segments",
    in_steps=True,
    recipe="hvf.training.recipes.temporal_distance:TemporalDistanceRecipe",
    assumes=(
        "what the keypoint dynamics assumes, whose keypoints it compares; "
        "random play takes as long one way as the other"
    ),
)

LAYERS = ModelEntry(
    about="Dynamics of an arm, coloured parts and sliders before a still camera (the desk).",
    kind="object",
    role="dynamics",
    module="hvf.models.layers.dynamics:LayerDynamics",
    plannable="hvf.worlds.layers:world_of",
    recipe="hvf.training.recipes.layers:LayersRecipe",
    assumes=(
        "a still camera and light; exactly 3 parts that roam and 2 that slide, each of a "
        "saturated colour of its own; an action of 3 numbers that displaces a hand, whose place "
        "alone says what the arm looks like; parts that move only near the hand, never turn, and "
        "are never before the arm"
    ),
    formerly=("DeskDynamics",),
)

LAYERS_GENERATOR = ModelEntry(
    about="Generator of subgoals that draws what the layers dynamics' scene may look like later.",
    kind="object",
    role="generator",
    module="hvf.models.layers.generator:LayerGenerator",
    plannable="hvf.worlds.layers_subgoals:subgoals_of",
    recipe="hvf.training.recipes.layers_generator:LayersGeneratorRecipe",
    assumes=(
        "what the layers dynamics assumes, which it draws with; a subgoal is 5 to 30 steps of "
        "play after the scene, and the next one after that"
    ),
    formerly=("DeskGenerator",),
)

LAYERS_PROPOSALS = ModelEntry(
    about="Proposals of subgoals for the layers generator: which change comes next, by network.",
    kind="object",
    role="proposals",
    module="hvf.models.layers.proposals:LayerProposals",
    plannable="hvf.worlds.layers_proposals:proposals_of",
    recipe="hvf.training.recipes.layers_proposals:LayersProposalsRecipe",
    assumes="what the layers generator assumes, whose latents it proposes",
)

LAYERS_DISTANCE = ModelEntry(
    about="Classifier of the steps of play between two states that the layers dynamics sees.",
    kind="object",
    role="distance",
    module="hvf.models.layers.distance:LayerDistance",
    plannable="hvf.worlds.steps:layer_steps",
    judge="hvf.worlds.steps:layer_segments",
    in_steps=True,
    recipe="hvf.training.recipes.layers_distance:LayersDistanceRecipe",
    assumes="what the layers dynamics assumes, whose states it compares",
)

CVAE = ModelEntry(
    about="The paper's generator of subgoal images: a CVAE given an image of the scene (the maze).",
    kind="video",
    role="generator",
    module="hvf.models.vae:CVAE",
    plannable="hvf.worlds.images:subgoals_of",
    recipe="hvf.training.recipes.vae:CVAERecipe",
    assumes="nothing of a scene but the size of its images; episodes of one scene each",
)

VAE = ModelEntry(
    about="The paper's generator of subgoal images without a scene: a VAE (the desk).",
    kind="video",
    role="generator",
    module="hvf.models.vae:VAE",
    plannable="hvf.worlds.images:subgoals_of",
    recipe="hvf.training.recipes.vae:VAERecipe",
    assumes="nothing of a scene but the size of its images; all data is of one scene",
)

SV2P = ModelEntry(
    about="The paper's dynamics: SV2P, stochastic variational video prediction.",
    kind="video",
    role="dynamics",
    module="hvf.models.sv2p.model:SV2P",
    plannable="hvf.worlds.video:world_of",
    in_torch=True,
    recipe="hvf.training.recipes.sv2p:SV2PRecipe",
    assumes="nothing of a scene but the size of its images, which 8 divides",
)

SV2P_SMALL = ModelEntry(
    about="SV2P with a quarter of its widths, for two cores.",
    kind="video",
    role="dynamics",
    module="hvf.models.sv2p.model:SV2PSmall",
    plannable="hvf.worlds.video:world_of",
    in_torch=True,
    recipe="hvf.training.recipes.sv2p:SV2PSmallRecipe",
    assumes="what sv2p assumes",
)

TAP = ModelEntry(
    about="Time-agnostic prediction: proposes an image between a start and a goal, without search.",
    kind="video",
    role="proposer",
    module="hvf.models.tap:TAP",
    plannable="hvf.worlds.images:proposer_of",
    recipe="hvf.training.recipes.tap:TAPRecipe",
    assumes="nothing of a scene but the size of its images",
)

TDM = ModelEntry(
    about="The paper's temporal distance: tells images a few steps apart from others, as a cost.",
    kind="video",
    role="distance",
    module="hvf.models.tdm:TDM",
    plannable="hvf.worlds.distances:tdm_of",
    judge="hvf.worlds.distances:tdm_judged",
    recipe="hvf.training.recipes.tdm:TDMRecipe",
    assumes="nothing of a scene but the size of its images",
)

RIG = ModelEntry(
    about="A policy for goal images that learned by reaching for imagined ones, in a VAE's latent.",
    kind="video",
    role="policy",
    module="hvf.models.rig:RIG",
    plannable="hvf.worlds.policy:policy_of",
    recipe="hvf.training.recipes.rig:RIGRecipe",
    assumes=(
        "nothing of a scene but the size of its images; that it may act in its domain while it "
        "learns; goals are imagined for all scenes at once"
    ),
)

LATENT = ModelEntry(
    about="A general compact world model: states of a few dozen numbers, planned with in Rust.",
    kind="video",
    role="dynamics",
    module="hvf.models.latent.model:LatentModel",
    plannable="hvf.worlds.latent:world_of",
    recipe="hvf.training.recipes.latent:LatentRecipe",
    assumes=(
        "nothing of a scene but the size of its images and actions; one frame tells all that "
        "matters for the next ones; things smaller than its blur need not be told apart"
    ),
)

SPATIAL_LATENT = ModelEntry(
    about="A general world model whose state is a grid of features; draws over the first frame.",
    kind="video",
    role="dynamics",
    module="hvf.models.spatial.model:SpatialLatent",
    plannable="hvf.worlds.video:world_of",
    in_torch=True,
    recipe="hvf.training.recipes.spatial:SpatialRecipe",
    assumes=(
        "nothing of a scene but the size of its images and actions; one frame tells all that "
        "matters for the next ones"
    ),
)

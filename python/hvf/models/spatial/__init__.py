"""The spatial latent model: a state that is a small grid of features."""

from hvf.models.spatial.config import SpatialConfig
from hvf.models.spatial.model import SpatialLatent

__all__ = ["SpatialConfig", "SpatialLatent"]

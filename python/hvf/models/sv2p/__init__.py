"""SV2P, the paper's video prediction model."""

from hvf.models.sv2p.config import SV2PConfig
from hvf.models.sv2p.model import SV2P, SV2PSmall

__all__ = ["SV2P", "SV2PConfig", "SV2PSmall"]

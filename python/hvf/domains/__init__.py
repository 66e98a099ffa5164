"""Places to plan in: what every command asks of one."""

from hvf.domains.domain import Domain, Place

__all__ = ["Domain", "Place"]

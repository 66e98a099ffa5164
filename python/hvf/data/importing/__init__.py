"""Data sets that others recorded, as files of episodes: ``hvf data import SOURCE PATH``.

A source is an :class:`~hvf.data.importing.importer.Import`, a dataclass whose fields are options.
Another package adds one by ``SOURCES.register("mine", MineImport)`` or by an entry point of the
group ``hvf.sources``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hvf.registry import Registry

if TYPE_CHECKING:
    from hvf.data.importing.importer import Import

SOURCES: Registry[type[Import]] = Registry(
    "source",
    "hvf.sources",
    {
        "bair": "hvf.data.importing.bair:BairImport",
        "rlds": "hvf.data.importing.rlds:RldsImport",
        "lerobot": "hvf.data.importing.lerobot:LeRobotImport",
        "folder": "hvf.data.importing.folder:FolderImport",
        "npz": "hvf.data.importing.npz:NpzImport",
    },
)
"""Kinds of data sets that can be imported."""

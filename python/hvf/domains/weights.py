"""Where the weights are that the package ships."""

from importlib.resources import files
from pathlib import Path

WEIGHTS = Path(str(files("hvf"))) / "weights"
"""Directory of the weights that the package ships."""

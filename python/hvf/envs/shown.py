"""Environments that can be looked at: scene and goal, in a window or as a picture."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

Image = NDArray[np.uint8]


class ShownEnv(gymnasium.Env[Any, NDArray[np.float32]]):
    """Draws scene and goal side by side; what they look like is for others to say.

    Attributes:
        title: of the window.
    """

    title: ClassVar[str]
    _state: NDArray[np.float64] | None = None
    _window: Any = None

    def render(self) -> Image | None:
        """Scene and goal side by side, uint8 ``[256, 520, 3]``; None in human mode.

        Raises:
            ResetNeeded: before the first ``reset``.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() without a render mode; give make() render_mode=...")
            return None
        if self._state is None:
            raise ResetNeeded("call reset before render")
        if self.render_mode == "human":
            self._show()
            return None
        return self._picture()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _show(self) -> None:
        """Show the picture in the window, which opens with the first."""
        from hvf.envs.window import Window

        if self._window is None:
            self._window = Window(self.title, self.metadata["render_fps"])
        self._window.show(self._picture())

    def _picture(self) -> Image:
        """Scene and goal of now, side by side."""
        raise NotImplementedError

"""The Franka desk: scene, physics, images, tasks and the Gymnasium environment.

MuJoCo is imported with this package only, not with :mod:`hvf`.
"""

import importlib.util

from hvf.envs.desk.opengl import check_environment

if importlib.util.find_spec("mujoco") is None:
    raise ImportError("the Franka desk needs MuJoCo 4 and Python 3.11: pip install 'mujoco>=4'")
# Before MuJoCo, which fails with an obscure error on a MUJOCO_GL whose library is missing.
check_environment()

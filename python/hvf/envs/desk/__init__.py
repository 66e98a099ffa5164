"""The Franka desk: scene, physics, images, tasks and the Gymnasium environment.

MuJoCo is imported with this package only, not with :mod:`hvf`.
"""

from hvf.envs.desk.opengl import check_environment

# Before MuJoCo, which otherwise fails on a MUJOCO_GL it cannot satisfy with an obscure error.
check_environment()

"""Hierarchical visual foresight."""

from hvf.envs import register_envs

register_envs()

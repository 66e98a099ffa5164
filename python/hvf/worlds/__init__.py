"""Worlds to plan in: learned models and simulators behind the planner's protocols."""

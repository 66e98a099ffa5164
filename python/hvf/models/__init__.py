"""Learned models: what they predict, and how their weights are kept."""

"""Hierarchical visual foresight."""

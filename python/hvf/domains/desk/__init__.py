"""The Franka desk as a domain."""

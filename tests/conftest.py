"""Settings of all tests."""

from hypothesis import settings

# No test depends on how fast, or how busy, the machine is.
settings.register_profile("hvf", deadline=None)
settings.load_profile("hvf")

"""What all tests share."""

from hypothesis import settings

# A first call may compile, and time says nothing about right or wrong.
settings.register_profile("groundfuse", deadline=None)
settings.load_profile("groundfuse")

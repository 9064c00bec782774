"""Settings of all tests: hypothesis has no deadline per example, because other tests load the machine."""

from hypothesis import settings

settings.register_profile("hilrig", deadline=None, print_blob=True)
settings.load_profile("hilrig")

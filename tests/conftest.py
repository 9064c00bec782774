"""What all tests share: on a busy machine an example of hypothesis may take its time."""

from hypothesis import settings

settings.register_profile("hilrig", deadline=None, print_blob=True)
settings.load_profile("hilrig")

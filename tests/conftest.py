"""Settings of all tests: hypothesis has no deadline per example, because other tests load the machine."""

import pytest
from hypothesis import settings

from support.long_tests import LONG

settings.register_profile("hilrig", deadline=None, print_blob=True)
settings.load_profile("hilrig")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the tests with the marker `long`, unless HILRIG_LONG is set."""
    if LONG:
        return
    for item in items:
        for marker in item.iter_markers("long"):
            item.add_marker(pytest.mark.skip(reason=f"{marker.args[0]}: make test-long"))

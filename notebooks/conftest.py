"""How the tests execute the notebooks."""

import os

import pytest


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item):
    """A notebook computes more than a test: its kernel compiles as a user's does, not in haste (tests/conftest.py)."""
    hasty = os.environ.pop("XLA_FLAGS", None)
    try:
        return (yield)
    finally:
        if hasty is not None:
            os.environ["XLA_FLAGS"] = hasty

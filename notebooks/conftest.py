"""How the tests execute the notebooks."""

import pytest


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item):
    """A notebook computes more than a test: its kernel compiles as a user's does, not in haste (tests/conftest.py).

    It writes nothing to the user's cache; what the test session has compiled is shared all the same.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("XLA_FLAGS", raising=False)
        patch.setenv("URRT_NO_CACHE", "1")
        return (yield)

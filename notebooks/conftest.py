"""How the tests execute the notebooks."""

import os
import tempfile

import pytest

_CACHE = "URRT_NOTEBOOKS_CACHE"


def pytest_configure(config: pytest.Config) -> None:
    """The notebooks of a session share what they compile, as those of a user do, in a folder of their own."""
    if not hasattr(config, "workerinput"):  # workers inherit the environment
        shared = tempfile.TemporaryDirectory(prefix="urrt-notebooks-")
        config.add_cleanup(shared.cleanup)
        os.environ[_CACHE] = shared.name


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item):
    """A notebook computes more than a test: its kernel compiles as a user's does, not in haste (tests/conftest.py)."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR", "URRT_NO_CACHE"):
            patch.delenv(name, raising=False)
        patch.setenv("XDG_CACHE_HOME", os.environ[_CACHE])
        return (yield)

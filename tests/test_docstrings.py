"""The documentation that lives in docstrings: its examples run, and the API reference is made from it."""

import doctest
import importlib
import inspect
import pkgutil

import pytest

import urrt_jax
from experiments import reference


def _examples() -> list:
    found = []
    for module in pkgutil.walk_packages(urrt_jax.__path__, "urrt_jax."):
        if not module.name.endswith("__main__"):
            found += doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(module.name))
    return [pytest.param(example, id=example.name) for example in found if example.examples]


@pytest.mark.parametrize("example", _examples())
def test_examples_in_docstrings_run_and_print_what_they_say(example):
    assert doctest.DocTestRunner().run(example).failed == 0


@pytest.mark.parametrize("name", urrt_jax.__all__)
def test_every_public_name_is_there_and_documented(name):
    assert inspect.getdoc(getattr(urrt_jax, name))


def test_reference_has_a_page_for_every_public_module_and_the_names_of_types(tmp_path):
    reference.Reference(out=tmp_path).run()
    page = (tmp_path / "urrt_jax.html").read_text()
    assert "CloudLike" in page and "Union[" not in page
    for name in urrt_jax.__all__:
        if inspect.ismodule(getattr(urrt_jax, name)):
            assert (tmp_path / "urrt_jax" / f"{name}.html").exists()

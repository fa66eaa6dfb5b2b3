"""Versions are known, or said to be unknown, however a package came to be importable."""

import importlib.metadata
import sys
from types import ModuleType

import torch

import softgm_bench
from softgm_bench.storage import versions


def not_installed(name):
    raise importlib.metadata.PackageNotFoundError(name)


def test_they_are_those_of_the_packages():
    found = versions.versions()
    assert found["torch"] == importlib.metadata.version("torch")
    assert found["softgm_bench"] == softgm_bench.__version__
    assert set(versions.PACKAGES) < set(found)


def test_a_package_that_is_importable_and_not_installed_has_its_modules_version(monkeypatch):
    monkeypatch.setattr(versions, "version", not_installed)
    found = versions.versions()
    assert found["torch"] == torch.__version__
    assert versions.version_of("softgm-bench") == softgm_bench.__version__
    assert all(found.values())


def test_what_says_no_version_or_is_not_there_is_unknown(monkeypatch):
    monkeypatch.setitem(sys.modules, "made_up", ModuleType("made_up"))
    assert versions.version_of("made_up") == versions.UNKNOWN
    assert versions.version_of("there-is-no-such-package") == versions.UNKNOWN

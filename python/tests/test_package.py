"""The names of the package."""

import importlib.metadata
import importlib.util
import re
import sys

import pytest

import tandem


def test_the_version_is_that_of_the_distribution():
    assert tandem.__version__ == importlib.metadata.version("tandem-rl")


def test_dir_lists_names_before_they_are_imported():
    pytest.importorskip("grpc")
    names = dir(tandem)
    assert {"Policy", "TandemEnv", "load_policy", "serve", "Bridge", "__version__"} <= set(names)
    assert not {"Any", "TYPE_CHECKING"} & set(names)


def test_every_listed_name_has_a_value_without_grpc(monkeypatch):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "grpc" else find_spec(name))
    monkeypatch.setitem(sys.modules, "grpc", None)
    for name in (name for names in tandem._SERVICES.values() for name in names):
        monkeypatch.delitem(vars(tandem), name, raising=False)
    assert "serve" not in dir(tandem)
    assert all(getattr(tandem, name) is not None for name in dir(tandem) if not name.startswith("__"))


def test_every_server_and_client_exists_and_is_in_the_help():
    pytest.importorskip("grpc")
    for names in tandem._SERVICES.values():
        for name in names:
            assert getattr(tandem, name) is not None
            assert re.search(rf"\b{name}\b", tandem.__doc__), name
    with pytest.raises(AttributeError, match="has no attribute 'Bride'"):
        tandem.Bride

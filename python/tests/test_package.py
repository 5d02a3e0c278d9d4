"""The names of the package."""

import importlib.metadata
import re

import pytest

import tandem


def test_the_version_is_that_of_the_distribution():
    assert tandem.__version__ == importlib.metadata.version("tandem-rl")


def test_dir_lists_names_before_they_are_imported():
    names = dir(tandem)
    assert {"Policy", "TandemEnv", "load_policy", "serve", "Bridge", "__version__"} <= set(names)
    assert not {"Any", "TYPE_CHECKING"} & set(names)


def test_every_server_and_client_exists_and_is_in_the_help():
    pytest.importorskip("grpc")
    for names in tandem._SERVICES.values():
        for name in names:
            assert getattr(tandem, name) is not None
            assert re.search(rf"\b{name}\b", tandem.__doc__), name
    with pytest.raises(AttributeError, match="has no attribute 'Bride'"):
        tandem.Bride

"""The messages and stubs of package tandem.v1, written by python/generate_stubs."""

"""The version, apart from everything else so that the build can read it without importing Deimos."""

__version__ = "0.2.1"

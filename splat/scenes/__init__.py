"""Scenes, and pycolmap, which is imported here for all.

pycolmap bundles its own zlib.  If it loads before Python's, the next PNG crashes.
"""

import zlib  # noqa: F401

import pycolmap  # noqa: F401

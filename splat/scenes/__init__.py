"""Scenes, and pycolmap, which is imported here for all.

It brings a zlib of its own.  Where that is loaded before Python's, the next PNG ends the process.
"""

import zlib  # noqa: F401

import pycolmap  # noqa: F401

"""Experiments of this repository: scripts that measure, and the results that they wrote. Not part of the library."""

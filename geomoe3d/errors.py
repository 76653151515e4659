"""Every error that geomoe3d raises on purpose.

A message says what is wrong, the value that was found, the limit it broke and what to do about it.
Anything else that escapes is a fault of the library. The command line turns the classes here into exit
code 2 (the input is at fault) and everything else into 1.
"""

from __future__ import annotations


class GeoMoE3DError(Exception):
    """Base of all errors raised on purpose."""


class InputError(GeoMoE3DError, ValueError):
    """The given data cannot be used: missing, malformed, too small or degenerate."""


class FormatError(InputError):
    """A file cannot be read or written in the format its suffix names."""


class EmptyCloudError(InputError):
    """A cloud holds fewer points than the operation needs."""


class NonFiniteError(InputError):
    """A cloud holds no finite points, or an argument that must be finite is not."""


class OutputError(GeoMoE3DError, OSError):
    """A result cannot be written: the file exists, the folder is missing or the disk refuses."""


class ConfigError(GeoMoE3DError, ValueError):
    """A configuration key or value is not valid; the message names the nearest valid key."""


class CheckpointError(GeoMoE3DError, ValueError):
    """Weights or a checkpoint do not fit: wrong architecture, broken hash, foreign format."""


class DependencyError(GeoMoE3DError, ImportError):
    """An optional part is not installed; the message gives the command that installs it."""

"""Every error that geomoe3d raises on purpose.

Each also derives from the builtin that fits, so ``except FileNotFoundError`` or ``except ValueError`` work as usual.
A message says what is wrong, the value that was found, the limit it broke and what to do about it.
Anything else that escapes is a fault of the library. The command line turns the classes here into exit
code 2 (the input is at fault) and everything else into 1.
"""

from __future__ import annotations

import re
import struct


class GeoMoE3DError(Exception):
    """Base of all errors raised on purpose."""


class InputError(GeoMoE3DError, ValueError):
    """The given data cannot be used: missing, malformed, too small or degenerate."""


class MissingFileError(InputError, FileNotFoundError):
    """There is no such file or folder to read."""

    __new__ = OSError.__new__  # type: ignore[assignment]  # what unpickles may ask for it by the first base


class ForbiddenFileError(InputError, PermissionError):
    """A file or folder may not be read."""

    __new__ = OSError.__new__  # type: ignore[assignment]  # what unpickles may ask for it by the first base


class FormatError(InputError):
    """A file cannot be read or written in the format its suffix names."""


class EmptyCloudError(InputError):
    """A cloud holds fewer points than the operation needs."""


class NonFiniteError(InputError):
    """A cloud holds no finite points, or an argument that must be finite is not."""


class OutputError(GeoMoE3DError, OSError):
    """A result cannot be written: the file exists, the folder is missing or the disk refuses."""


class ExistingFileError(OutputError, FileExistsError):
    """A file is there already, and it was not said that it may be replaced."""


class ConfigError(GeoMoE3DError, ValueError):
    """A configuration key or value is not valid; the message names the nearest valid key."""


class MissingConfigError(ConfigError, FileNotFoundError):
    """There is no such configuration file."""

    __new__ = OSError.__new__  # type: ignore[assignment]  # what unpickles may ask for it by the first base


class CheckpointError(GeoMoE3DError, ValueError):
    """Weights or a checkpoint do not fit: wrong architecture, broken hash, foreign format."""


class MissingWeightsError(CheckpointError, FileNotFoundError):
    """There are no such weights, or no such checkpoint."""

    __new__ = OSError.__new__  # type: ignore[assignment]  # what unpickles may ask for it by the first base


class DependencyError(GeoMoE3DError, ImportError):
    """An optional part is not installed; the message gives the command that installs it."""


def plain_reason(error: BaseException) -> str:
    """What a library complains of in a file, without words that only its programmers know."""
    if isinstance(error, UnicodeError):
        return "it is no text in UTF-8"
    if isinstance(error, KeyError):
        return f"{error} is missing in it"
    if isinstance(error, (IndexError, EOFError, struct.error)):
        return "it ends too early, or a number in it is wrong"
    if isinstance(error, RecursionError):
        return "its brackets are nested too deeply"
    if isinstance(error, OverflowError):
        return "a number in it is too large"
    if isinstance(error, (TypeError, AttributeError)):
        return "a value in it is of another kind than belongs there"
    said = " ".join(str(error).split()) or "its content makes no sense"
    for pattern, words in _IN_WORDS:
        said = re.sub(pattern, words, said)
    return said


_IN_WORDS = (
    (r"could not convert string to float: (.+)", r"\1 is no number"),
    (r"could not convert string (.+) to \w+ at row \d+, column (\d+)\.?", r"\1 in column \2 is no number"),
    (r"the number of columns changed from (\d+) to (\d+) at .*", r"a row has \2 numbers, those before it \1"),
)
"""What numpy and Python say of text that is no table of numbers, and what is said instead."""


def cannot_read(error: OSError, message: str) -> InputError:
    """The class of `InputError` for what the system says: missing, forbidden or anything else."""
    kind: type[InputError] = InputError
    if isinstance(error, FileNotFoundError):
        kind = MissingFileError
    elif isinstance(error, PermissionError):
        kind = ForbiddenFileError
    return kind(message)

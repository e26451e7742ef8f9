"""The exceptions of the package: one clear sentence each, naming the file, topic or value, and the remedy."""

from collections.abc import Iterator
from contextlib import contextmanager


class HandPoseError(Exception):
    """Base of every error that this package raises on purpose."""


class InputError(HandPoseError):
    """An image, camera model, bag or file that cannot be used."""


class BagOptionError(InputError):
    """A bag that can be used only with one of the options in `cli.arguments.add_bag`. The message names it."""


class CheckpointError(HandPoseError):
    """Weights that are missing, damaged, or of another kind than expected."""


class TrainingError(HandPoseError):
    """Training cannot start or go on."""


def counted(number: int, things: str) -> str:
    """'1 image' or '2 images', for messages."""
    return f'{number} {things if number != 1 else things.removesuffix("s")}'


@contextmanager
def naming(source: object) -> Iterator[None]:
    """Begin the message of an InputError with the topic or file that it is about, unless `source` is empty."""
    try:
        yield
    except InputError as error:
        raise InputError(f'{source}: {error}' if source else str(error)) from error

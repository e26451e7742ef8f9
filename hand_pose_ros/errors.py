"""The exceptions of the package: one clear sentence each, naming the file, topic or value, and the remedy."""


class HandPoseError(Exception):
    """Base of every error that this package raises on purpose."""


class InputError(HandPoseError):
    """An image, camera model, bag or file that cannot be used."""


class CheckpointError(HandPoseError):
    """Weights that are missing, damaged, or of another kind than expected."""

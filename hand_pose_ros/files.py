"""Files that appear in one step, so that nobody ever sees half of one."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hand_pose_ros.errors import InputError


@contextmanager
def in_one_step(path: str | Path) -> Iterator[Path]:
    """A file beside `path` to write to. It becomes `path` when the block ends. After an error, nothing is left.

    If `path` is a link, its target is replaced. A device or FIFO (/dev/stdout) is written to directly.

    Raises:
        InputError: the folder cannot be made or written, or the disk is full.
    """
    if _is_device(path):
        yield Path(path)
        return
    path = Path(os.path.realpath(path))  # resolve() raises RuntimeError at a link that leads to itself
    part = _begin(path)
    mode = part.stat().st_mode
    try:
        with naming_full_disk(path):
            yield part
        os.chmod(part, mode)  # some libraries keep their files to their owner
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def naming_full_disk(path: str | Path) -> Iterator[None]:
    """Raise InputError with the name of the file if the block ends because a disk is full, or cannot take the file."""
    try:
        yield
    except Exception as error:  # libraries raise exceptions of their own
        if re.search('No space left|disk is full|quota exceeded', str(error), re.IGNORECASE):
            raise InputError(f'{path}: cannot be written, for the disk is full: make room, or choose another place'
                             ) from error
        # Causes are 4 GB on FAT, ulimit -f, or a disk that was pulled out. SQLite calls all of them an I/O error.
        if re.search('File too large|Input/output error|disk I/O error', str(error)):
            raise InputError(f'{path}: cannot be written ({error}): choose another place') from error
        raise


def check_writable(path: str | Path) -> None:
    """Raise InputError if the file cannot be written. Call this before the work."""
    if not _is_device(path):
        _begin(Path(os.path.realpath(path))).unlink()


def _is_device(path: str | Path) -> bool:
    """Whether there is a device or a FIFO, which is not replaced but written to."""
    return Path(path).exists() and not Path(path).is_file() and not Path(path).is_dir()


def _begin(path: Path) -> Path:
    """An empty file beside `path`."""
    if path.is_dir():
        raise InputError(f'{path} is a folder: give the name of a file')
    part = path.with_name(f'.{path.name}.{os.getpid()}.part')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.touch()
    except OSError as error:
        raise InputError(f'{path}: cannot be written ({error.strerror}): choose another place') from None
    return part


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a whole file in one step."""
    with in_one_step(path) as part:
        part.write_bytes(data)


def write_json(path: str | Path, value: Any) -> None:
    """Write strict JSON (no NaN) in one step."""
    write_bytes(path, (json.dumps(value, indent=2, allow_nan=False) + '\n').encode())

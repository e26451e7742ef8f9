"""A bag of any kind: its topics, and as many of its serialized messages as can be read."""

from __future__ import annotations

import io
import os
import shlex
import struct
from collections.abc import Collection, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, TypeVar
from urllib.parse import quote

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from hand_pose_ros.errors import InputError, counted
from hand_pose_ros.resources import resource

IMAGE, COMPRESSED_IMAGE = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
HAND, HANDS, SKELETON = (f'hand_pose_ros/msg/{name}' for name in ('HandJoints', 'HandJointsArray', 'HandSkeleton'))

_Self = TypeVar('_Self', bound='Bag')


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """The message types of ROS 2 and of this package."""
    store = get_typestore(Stores.LATEST)
    for name in (HAND, HANDS, SKELETON):
        store.register(get_types_from_msg(resource(f'msg/{name.rpartition("/")[2]}.msg').read_text(), name))
    return store


class Bag:
    """Any bag, open for reading: a ROS 1 file, a ROS 2 folder, or one of its .mcap or .db3 files.

    An interrupted recording leaves a ROS 2 folder without metadata.yaml, or an MCAP file without its end. They are read
    as far as possible.

    Raises:
        InputError: the bag is missing, of an unknown kind, or too damaged to be read.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._reader, self._interrupted = _open(self.path)
        self.connections: list[Connection] = list(self._reader.connections)
        self.is_ros1 = not self._reader.is2
        self.typestore: Typestore = self._reader.typestore
        self.start_ns: int = self._reader.start_time
        self._closed = False

    def messages(self, connections: Collection[Connection],
                 start: int | None = None) -> Iterator[tuple[Connection, int, bytes]]:
        """Connection, time of recording [ns] and serialized data of each message, in the order of time.

        Args:
            start: leave out messages recorded before this time, ns.

        Raises:
            InputError: the bag is damaged, or was cut short. Everything before the damage comes first.
        """
        count = 0
        try:
            for message in self._reader.messages(connections=connections, start=start):
                yield message
                count += 1
        except Exception as error:  # sqlite and the decompressors raise errors of their own
            self._check_open()
            raise InputError(f'{self.path}: the bag is damaged after {counted(count, "messages")} ({_said(error)}); '
                             f'{_remedy(self.path)}') from error
        if self._interrupted:
            raise InputError(f'{self.path}: the bag was cut short after {counted(count, "messages")}, as by an '
                             f'interrupted recording or copy; {_remedy(self.path)}')

    def first(self, connection: Connection) -> Any:
        """The first message of a connection; None if it has none.

        Raises:
            InputError: the bag or the message is damaged.
        """
        if connection.msgcount == 0:
            return None
        for _, _, data in self.messages([connection]):
            return self.deserialize(connection, data)
        raise InputError(f'{self.path}: the bag counts messages on {connection.topic} that are not there; '
                         f'{_remedy(self.path)}')

    def deserialize(self, connection: Connection, data: bytes) -> Any:
        """The message as an object with the fields of its definition.

        Raises:
            InputError: the message is damaged.
        """
        try:
            return self._reader.deserialize(data, connection.msgtype)
        except Exception as error:  # random bytes can cause any error
            self._check_open()
            if bytes(data[:4]) == b'\x28\xb5\x2f\xfd':  # zstd; only metadata.yaml says that messages are compressed
                raise InputError(f'{self.path}: its messages are compressed, which only metadata.yaml says: give the '
                                 'folder that holds both, or make that file with `ros2 bag reindex FOLDER`') from error
            raise InputError(f'{self.path}: a message on {connection.topic} is damaged ({_said(error)}): record or '
                             'copy the bag again') from error

    def close(self) -> None:
        """Close the files. After this, the bag cannot be read."""
        if not self._closed:
            self._closed = True
            self._reader.close()

    def _check_open(self) -> None:
        if self._closed:
            raise InputError(f'{self.path}: the bag was closed: read it inside its `with` block')

    def __enter__(self: _Self) -> _Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _open(path: Path) -> tuple[AnyReader, bool]:
    """A reader of the bag, and whether it reads only what an interrupted recording has left."""
    if not path.exists():
        raise InputError(f'{path}: there is no such bag: check the path')
    files = [file for kind in ('mcap', 'db3') for file in path.glob(f'*.{kind}')] if path.is_dir() else [path]
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        if len(files) != 1:
            raise InputError(f'{path}: there is no metadata.yaml in this folder; {_remedy(path)}')
        path = files[0]
    attempts: list[Any] = [PathForSqlite(path)]
    if len(files) == 1:
        if path.is_dir():
            attempts.append(PathForSqlite(files[0]))
        if files[0].suffix == '.mcap':
            attempts.append(_InterruptedMcap(files[0]))
    failure: Exception | None = None
    for attempt in attempts:
        try:
            reader = AnyReader([attempt], default_typestore=typestore())
            reader.open()
            interrupted = isinstance(attempt, _InterruptedMcap)
            if reader.connections or not interrupted:
                return reader, interrupted
            reader.close()
            failure = InputError('it was cut short before its first chunk was complete')
        except Exception as error:  # sqlite, YAML and the decompressors raise errors of their own
            failure = failure or error
    raise InputError(f'{path}: the bag cannot be opened ({_said(failure)}); {_remedy(path)}') from failure


class PathForSqlite(type(Path())):  # type: ignore[misc]
    """A path that quotes itself. rosbags puts it into a URI of SQLite, where %, ? and # have a special meaning."""

    def __format__(self, _spec: str) -> str:
        return quote(os.fsencode(self))


def _said(error: Exception | None) -> str:
    """The error message of a library, in one line; the type of the error if there is no message."""
    return ' '.join(str(error).split()) or type(error).__name__


def _remedy(path: Path) -> str:
    """What to do with a damaged bag. Commands are in backticks, because more text may follow them."""
    quoted = shlex.quote(str(path))
    wanted = 'give a .bag, .mcap or .db3 file or the folder of a ROS 2 bag'
    if path.is_file() and not path.stat().st_size:
        return 'it is empty: record or copy it again'
    if path.suffix == '.bag':
        return f'if it was cut short, repair a copy with `rosbag reindex {quoted}`'
    if path.suffix == '.mcap' and path.is_file():
        with open(path, 'rb') as file:
            if file.read(5) != b'\x89MCAP':
                return f'it is no MCAP file: {wanted}'
        return f'repair it with mcap (github.com/foxglove/mcap): `mcap recover {quoted} -o repaired.mcap`'
    if path.suffix == '.db3':
        return f'repair it with `sqlite3 {quoted} .recover | sqlite3 repaired.db3`'
    return f'{wanted}, or repair that folder with `ros2 bag reindex {quoted}`' if path.is_dir() else wanted


class _InterruptedMcap:
    """An MCAP file without its end. For rosbags it looks as if it had been closed after its last complete record."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.suffix = path.suffix

    def exists(self) -> bool:
        return True

    def is_dir(self) -> bool:
        return False

    def open(self, _mode: str) -> BinaryIO:
        file = self._path.open('rb')
        return io.BufferedReader(_Joined(file, _complete_records(file), _MCAP_END))


_MCAP_MAGIC = b'\x89MCAP0\r\n'
_MCAP_END = struct.pack('<BQQQI', 2, 20, 0, 0, 0) + _MCAP_MAGIC  # this footer says that there is no summary


def _complete_records(file: BinaryIO) -> int:
    """The end of the last complete record in the data section of an MCAP file, in bytes."""
    size = file.seek(0, io.SEEK_END)
    end = len(_MCAP_MAGIC)
    while end + 9 <= size:
        file.seek(end)
        kind, length = struct.unpack('<BQ', file.read(9))
        if kind in (0x00, 0x02, 0x0f) or end + 9 + length > size:  # not written, footer, end of data
            break
        end += 9 + length
    return end


class _Joined(io.RawIOBase):
    """The first `length` bytes of a file, followed by `tail`, as one file."""

    def __init__(self, file: BinaryIO, length: int, tail: bytes) -> None:
        self._file, self._length, self._tail, self._at = file, length, tail, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = (0, self._at, self._length + len(self._tail))[whence] + offset
        return self._at

    def readinto(self, buffer: Any) -> int:
        if self._at < self._length:
            self._file.seek(self._at)
            data = self._file.read(min(len(buffer), self._length - self._at))
        else:
            data = self._tail[self._at - self._length:][:len(buffer)]
        buffer[:len(data)] = data
        self._at += len(data)
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()

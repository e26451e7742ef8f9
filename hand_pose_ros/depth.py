"""Bytes of a depth image -> depth in metres, float32, where 0 means "no reading".

Supported inputs:

- sensor_msgs/Image with the encodings 16UC1, mono16 and 32FC1 (REP-118)
- sensor_msgs/CompressedImage with the transports `compressedDepth` (PNG and RVL) and `compressed` (16-bit PNG, TIFF)
- 16-bit PNG files

A message may come from rclpy or from a bag reader, or be any object with the same attributes.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.conventions import ZSTD, ZSTD_REMEDY
from hand_pose_ros.errors import InputError, naming

DEPTH_ENCODINGS: dict[str, np.dtype[Any]] = {
    '16UC1': np.dtype('u2'), 'mono16': np.dtype('u2'), '32FC1': np.dtype('f4')}
"""The encodings that hold depth, and the type of their pixels."""

MAX_PIXELS, MAX_SIDE = 1 << 24, 1 << 13
"""Far above any depth camera. An image that claims more is corrupt. It must not use up memory or, if it is long and
thin, time."""

MAX_OUTSIDE = 0.99
"""If more than this share of the readings is out of range, the unit of depth is probably wrong."""

_PNG_SIGNATURE = b'\x89PNG\r\n\x1a\n'
_HEADER = struct.Struct('<iff')  # compressedDepth: kind of quantisation and its parameters A and B
_SMALLEST, _LARGEST = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)


def decode_image(msg: Any, depth_scale: float = 0.001, *, source: str = '') -> NDArray[np.float32]:
    """Depth (H, W) in metres of a sensor_msgs/Image. 0 = no reading; so are NaN, Inf and negative values (REP-117).

    Args:
        msg: has `height`, `width`, `step`, `encoding` (see DEPTH_ENCODINGS), `is_bigendian`, `data` (any buffer).
        depth_scale: metres per unit of the 16-bit encodings. 32FC1 is always in metres.
        source: the topic or file, to begin error messages with.

    Raises:
        InputError: the encoding is not depth, the image is empty or impossibly large, a row is shorter than the width,
            there is less data than the rows need, or depth_scale is not positive.
    """
    with naming(source):
        height, width, step = int(msg.height), int(msg.width), int(msg.step)
        if msg.encoding not in DEPTH_ENCODINGS:
            raise InputError(f'the encoding {msg.encoding!r:.80} is not depth: choose a topic with one of '
                             f'{", ".join(DEPTH_ENCODINGS)}')
        if height <= 0 or width <= 0:
            raise InputError(f'the image is empty ({width}x{height} pixels): does the camera stream depth?')
        pixel = DEPTH_ENCODINGS[msg.encoding].newbyteorder('>' if msg.is_bigendian else '<')
        if step < width * pixel.itemsize:
            raise InputError(f'step is {step} bytes but a row of {width} pixels of {msg.encoding} takes '
                             f'{width * pixel.itemsize}: the publisher must fill in step = bytes per row')
        data = memoryview(msg.data)
        if data.nbytes < step * height:
            raise InputError(f'{data.nbytes} bytes of data are fewer than step x height = {step} x {height}: '
                             'the image was cut short; check the publisher or the recording')
        _check_size(width, height)
        pixels: NDArray[Any] = np.ndarray((height, width), pixel, data, strides=(step, pixel.itemsize))
        return to_metres(pixels, depth_scale) if pixel.kind == 'u' else _sanitised(pixels)


def decode_compressed(msg: Any, depth_scale: float = 0.001, *, source: str = '') -> NDArray[np.float32]:
    """Depth (H, W) in metres of a sensor_msgs/CompressedImage; 0 = no reading.

    Args:
        msg: has `format` and `data` (any buffer). Formats of the transport compressedDepth: `16UC1; compressedDepth
            png` and `... rvl`; without a codec, or with nothing after the encoding, the codec is png. Formats of the
            transport compressed: `16UC1; png compressed` and `...; tiff compressed`. 32FC1 is inverse depth, quantised
            to 16 bits, except in TIFF, where it is metres.
        depth_scale: metres per unit of the 16-bit encodings.
        source: the topic or file, to begin error messages with.

    Raises:
        InputError: the format is another one, the data is corrupt, or depth_scale is not positive.
    """
    with naming(source):
        words = msg.format.replace(';', ' ').split()
        encoding = words[0] if words else ''
        if encoding == ZSTD:
            raise InputError(ZSTD_REMEDY)
        if encoding not in DEPTH_ENCODINGS:
            raise InputError(f'the format {msg.format!r:.80} is not compressed depth: choose a topic whose format '
                             f"begins with {', '.join(DEPTH_ENCODINGS)} (such as '16UC1; compressedDepth png')")
        data = memoryview(msg.data).cast('B')
        if 'tiff' in words:
            pixels = _decode_tiff(data, DEPTH_ENCODINGS[encoding])
            return to_metres(pixels, depth_scale) if pixels.dtype.kind == 'u' else _sanitised(pixels)
        plain = bytes(data[:8]) == _PNG_SIGNATURE  # the `compressed` transport writes no header
        if DEPTH_ENCODINGS[encoding].kind == 'u':
            return to_metres(_decode_units(data[0 if plain else _HEADER.size:], words), depth_scale)
        if plain or len(data) < _HEADER.size:
            raise InputError(f'the header of the format {msg.format!r:.80} is missing: publish 32FC1 depth with '
                             'the transport compressedDepth, or as a raw image')
        _, a, b = _HEADER.unpack_from(data)
        return _from_inverse_depth(_decode_units(data[_HEADER.size:], words), a, b)


def encode_compressed(
        depth: NDArray[np.float32], codec: str = 'png', depth_scale: float = 0.001) -> tuple[str, bytes]:
    """`format` and `data` of a 16UC1 sensor_msgs/CompressedImage, for a `.../compressedDepth` topic.

    Args:
        depth: (H, W) in metres, 0 = no reading. See `to_units` for what 16 bits can hold.
        codec: 'png' (smaller) or 'rvl' (faster to decode in C++ players).

    Raises:
        InputError: the codec is another one, or depth_scale is not positive.
    """
    if codec not in ('png', 'rvl'):
        raise InputError(f"unknown codec '{codec}': choose png or rvl")
    units = to_units(depth, depth_scale)
    payload = encode_rvl(units) if codec == 'rvl' else encode_png(units)
    return f'16UC1; compressedDepth {codec}', _HEADER.pack(-1, 0.0, 0.0) + payload


def read_png(path: str | Path, depth_scale: float = 0.001) -> NDArray[np.float32]:
    """Depth (H, W) in metres of a 16-bit greyscale PNG file; 0 = no reading.

    Raises:
        InputError: the file cannot be read, is not a PNG, is damaged, or does not have one channel of 16 bits; or
            depth_scale is not positive.
    """
    with naming(str(path)):
        try:
            data = Path(path).read_bytes()
        except OSError as error:
            raise InputError(f'the file cannot be read ({error.strerror}): check the path') from None
        return to_metres(_decode_png(memoryview(data)), depth_scale)


def depth_problem(depth: NDArray[np.float32], near: float, far: float, scale_is_right: bool = False) -> str:
    """What may be wrong with a depth image (H, W) [m] in which no hand was found. Empty if the image looks sane.

    Args:
        near, far: range in which hands are looked for, metres.
        scale_is_right: a hand was seen at this depth_scale before. So readings out of range are only far away.
    """
    sample = depth[::8, ::8]
    readings = sample[sample > 0]
    if readings.size == 0:
        return 'the depth image has no reading at all (all zero or not finite): is something in front of the lens?'
    outside = float(np.mean((readings < near) | (readings > far)))
    if outside < MAX_OUTSIDE or scale_is_right:
        return ''
    return (f'{outside:.0%} of the depth is outside {near:g} to {far:g} m (median {float(np.median(readings)):.3g} m): '
            'check depth_scale (0.001 for most cameras, 0.000125 for a RealSense SR305; 32FC1 has none, but must be '
            'metres), or the range')


def to_metres(units: NDArray[np.uint16], depth_scale: float = 0.001) -> NDArray[np.float32]:
    """Sensor units (H, W) -> metres, float32; `depth_scale` is in metres per unit."""
    _check_scale(depth_scale)
    return np.multiply(units, np.float32(depth_scale), dtype=np.float32)


def to_units(depth: NDArray[np.float32], depth_scale: float = 0.001) -> NDArray[np.uint16]:
    """Metres (H, W) -> the nearest sensor units. A value that does not fit into 16 bits becomes 0, "no reading"."""
    _check_scale(depth_scale)
    units = np.rint(np.asarray(depth, np.float64) / depth_scale)
    return np.where((units > 0) & (units <= 0xFFFF), units, 0).astype(np.uint16)


def encode_png(units: NDArray[np.uint16]) -> bytes:
    """Sensor units (H, W) -> a 16-bit greyscale PNG."""
    native = np.asarray(units, np.uint16)  # OpenCV assumes the byte order of this machine
    return cv2.imencode('.png', native)[1].tobytes()


def encode_rvl(units: NDArray[np.uint16]) -> bytes:
    """Sensor units (H, W) -> RVL (Wilson 2017), after the width and the height, as in compressedDepth.

    The stream consists of runs. A run is the number of zeros, the number of other values, and the differences between
    these values. Each of these numbers is split into groups of 3 bits, the low bits first. Each group is a nibble; its
    highest bit (8) says that another group of the same number follows.
    """
    flat = np.asarray(units, np.int64).ravel()
    changes = np.flatnonzero(np.diff(flat != 0, prepend=False)) if flat.size else np.empty(0, np.int64)
    edges = np.concatenate([[0], changes, [flat.size] * (1 + (len(changes) % 2 == 0))])
    lengths = np.diff(edges).reshape(-1, 2)  # one row for each run: zeros, other values
    values = flat[flat != 0]
    delta = np.diff(values, prepend=0)
    numbers = np.insert((delta << 1) ^ (delta >> 63),
                        np.repeat(np.concatenate([[0], np.cumsum(lengths[:-1, 1])]), 2), lengths.ravel())

    groups = np.maximum(1, -(-np.ceil(np.log2(numbers + 1)).astype(np.int64) // 3))
    starts = np.cumsum(groups) - groups
    nibbles = np.zeros(-(-int(groups.sum()) // 8) * 8, np.uint8)
    for k in range(int(groups.max())):
        has = groups > k
        nibbles[starts[has] + k] = (numbers[has] >> 3 * k & 7) | (groups[has] > k + 1) * 8
    words = (nibbles[::2] << 4 | nibbles[1::2]).view('>u4').astype('<u4')
    height, width = units.shape
    return struct.pack('<II', width, height) + words.tobytes()


def decode_rvl(data: bytes | memoryview) -> NDArray[np.uint16]:
    """The inverse of `encode_rvl`: (H, W) sensor units.

    Raises:
        InputError: the data is corrupt.
    """
    corrupt = 'the RVL data is corrupt ({}): the message was cut short or is of another format'
    if len(data) < 8:
        raise InputError(corrupt.format(f'{len(data)} bytes hold no image size'))
    width, height = struct.unpack_from('<II', data)
    _check_size(width, height)
    pixels = width * height

    payload = np.frombuffer(data, np.uint8, offset=8)
    octets = payload[:len(payload) // 4 * 4].view('<u4').astype('>u4').view(np.uint8)
    nibbles: NDArray[np.uint8] = np.stack([octets >> 4, octets & 15], axis=1).ravel()
    ends = np.flatnonzero(nibbles < 8)
    groups = np.diff(ends, prepend=-1)
    if len(groups) == 0 or groups.max() > 11:
        raise InputError(corrupt.format('a number without end'))
    nibbles = nibbles[:ends[-1] + 1]
    position = np.arange(len(nibbles)) - np.repeat(ends - groups + 1, groups)
    numbers = np.add.reduceat((nibbles & 7).astype(np.int64) << 3 * position, ends - groups + 1)

    # The end of a run is only known when it is reached, so this needs a loop. All else is done at once.
    heads: list[int] = []
    lengths: list[int] = []
    at = filled = 0
    while filled < pixels:
        if at + 2 > len(numbers):
            raise InputError(corrupt.format(f'it ends after {filled} of {pixels} pixels'))
        run = numbers.item(at), numbers.item(at + 1)
        heads.append(at)
        lengths += run
        filled += sum(run)
        at += 2 + run[1]
    if filled > pixels or at > len(numbers):
        raise InputError(corrupt.format('a run of pixels leaves the image'))
    is_value = np.ones(at, bool)
    is_value[heads] = is_value[np.add(heads, 1)] = False
    zigzag = numbers[:at][is_value]
    values = np.cumsum((zigzag >> 1) ^ -(zigzag & 1))
    if len(values) and not 0 <= values.min() <= values.max() <= 0xFFFF:
        raise InputError(corrupt.format('a value of more than 16 bits'))
    units = np.zeros(pixels, np.uint16)
    units[np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)] = values
    return units.reshape(height, width)


def _decode_units(payload: memoryview, words: list[str]) -> NDArray[np.uint16]:
    """The 16-bit image in a compressed message. The words of its format say which codec it has."""
    return decode_rvl(payload) if 'rvl' in words else _decode_png(payload)


def _decode_png(data: memoryview) -> NDArray[np.uint16]:
    """(H, W) sensor units. The header is checked first, so that a corrupt one cannot use up memory."""
    if len(data) < 26 or bytes(data[:8]) != _PNG_SIGNATURE or bytes(data[12:16]) != b'IHDR':
        raise InputError('the data is not a PNG: the file or message was cut short or is of another format')
    width, height, bits, color = struct.unpack_from('>IIBB', data, 16)
    if (bits, color) != (16, 0):
        raise InputError(f'the PNG has {bits} bits per {"colour" if color else "grey value"}, which is not '
                         'metric depth: record 16-bit greyscale (one channel)')
    _check_size(width, height)
    end, kind = 8, b''
    while end + 8 <= len(data) and kind != b'IEND':  # OpenCV allocates whatever length a chunk claims
        length, kind = struct.unpack_from('>I4s', data, end)
        end += length + 12
    return _imdecode(data if end <= len(data) else data[:0], 'PNG', (height, width), np.dtype('u2'))


def _decode_tiff(data: memoryview, pixel: np.dtype[Any]) -> NDArray[Any]:
    """(H, W) pixels of the type `pixel`. The header is checked first, as for PNG."""
    sizes = {}
    try:
        order = {b'II': '<', b'MM': '>'}[bytes(data[:2])]
        start, = struct.unpack_from(order + 'I', data, 4)
        entries, = struct.unpack_from(order + 'H', data, start)
        for at in range(start + 2, start + 2 + 12 * entries, 12):
            tag, kind = struct.unpack_from(order + 'HH', data, at)
            if tag in (256, 257):  # width, height: 16 or 32 bits
                sizes[tag], = struct.unpack_from(order + ('H' if kind == 3 else 'I'), data, at + 8)
        width, height = sizes[256], sizes[257]
    except (KeyError, struct.error):
        raise InputError('the data is not a TIFF: the message was cut short or is of another format') from None
    _check_size(width, height)
    return _imdecode(data, 'TIFF', (height, width), pixel)


def _imdecode(data: memoryview, kind: str, shape: tuple[int, int], pixel: np.dtype[Any]) -> NDArray[Any]:
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if len(data) else None
    except cv2.error:
        pixels = None
    if pixels is None or pixels.dtype != pixel or pixels.shape != shape:
        raise InputError(f'the {kind} of {shape[1]}x{shape[0]} pixels is damaged, or not of one channel of '
                         f'{8 * pixel.itemsize} bits: record or copy it again')
    return pixels


def _check_scale(depth_scale: float) -> None:
    if not 0 < depth_scale < np.inf:
        raise InputError(f'depth_scale is {depth_scale}: give the metres per unit (0.001 for millimetres)')


def _check_size(width: int, height: int) -> None:
    if not 0 < width * height <= MAX_PIXELS or max(width, height) > MAX_SIDE:
        raise InputError(f'the image claims {width}x{height} pixels, which cannot be: '
                         'the data is corrupt or of another format')


def _from_inverse_depth(units: NDArray[np.uint16], a: float, b: float) -> NDArray[np.float32]:
    """Quantised inverse depth (H, W) -> metres: z = A / (q - B). q = 0 means no reading."""
    if not (np.isfinite([a, b]).all() and a > 0):
        raise InputError(f'inverse depth cannot be quantised with A={a}, B={b}: the header is corrupt')
    with np.errstate(divide='ignore', over='ignore'):
        depth = np.float32(a) / (units - np.float32(b))
    depth[units == 0] = 0
    return _sanitised(depth)


def _sanitised(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """A contiguous copy (H, W). Everything that is not a positive finite number is 0 in it."""
    depth = np.ascontiguousarray(depth, np.float32)
    return np.asarray(cv2.copyTo(depth, cv2.inRange(depth, _SMALLEST, _LARGEST)))

"""What depth decoding promises: every encoding and transport exactly, and one clear sentence for everything else."""

import array
import struct
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hand_pose_ros.depth import (
    decode_compressed,
    decode_image,
    decode_rvl,
    encode_compressed,
    encode_png,
    encode_rvl,
    read_png,
    to_units,
)
from hand_pose_ros.errors import InputError

UNITS = hnp.arrays(np.uint16, hnp.array_shapes(min_dims=2, max_dims=2, max_side=40),
                   elements=st.one_of(st.just(0), st.integers(0, 65535), st.integers(600, 605)))


def image(pixels, *, encoding='16UC1', padding=0, big=False, buffer=bytes):
    """A sensor_msgs/Image with rows padded by so many bytes."""
    pixels = np.asarray(pixels)
    rows = pixels.astype(pixels.dtype.newbyteorder('>' if big else '<')).view(np.uint8).reshape(len(pixels), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xAB)
    return SimpleNamespace(height=pixels.shape[0], width=pixels.shape[1], step=rows.shape[1], encoding=encoding,
                           is_bigendian=int(big), data=buffer(rows.tobytes()))


def compressed(form, payload, header=b'\0' * 12):
    return SimpleNamespace(format=form, data=header + payload)


def tiff(pixels):
    return cv2.imencode('.tif', pixels)[1].tobytes()


@pytest.fixture
def units():
    noise = np.random.default_rng(5).integers(400, 5000, (48, 65)).astype(np.uint16)
    noise[noise % 5 == 0] = 0
    return noise


@pytest.mark.parametrize('encoding', ['16UC1', 'mono16'])
@pytest.mark.parametrize('padding', [0, 1, 6])
@pytest.mark.parametrize('big', [False, True])
def test_sixteen_bits_are_units_of_depth_scale(units, encoding, padding, big):
    message = image(units, encoding=encoding, padding=padding, big=big)
    depth = decode_image(message, 0.000125)
    assert depth.dtype == np.float32 and depth.flags.c_contiguous and depth.flags.writeable
    np.testing.assert_allclose(depth, units * 0.000125, rtol=1e-6)


@pytest.mark.parametrize('buffer', [bytes, bytearray, memoryview, lambda b: array.array('B', b),
                                    lambda b: np.frombuffer(b, np.uint8), lambda b: np.frombuffer(b, np.uint16)])
def test_data_can_be_any_buffer(units, buffer):
    np.testing.assert_array_equal(decode_image(image(units, buffer=buffer)), decode_image(image(units)))
    form, data = encode_compressed(units * np.float32(0.001), 'rvl')
    np.testing.assert_array_equal(decode_compressed(SimpleNamespace(format=form, data=buffer(data))),
                                  decode_image(image(units)))


@pytest.mark.parametrize('padding', [0, 3, 8])
@pytest.mark.parametrize('big', [False, True])
def test_floats_are_metres_and_what_is_no_distance_is_no_reading(padding, big):
    pixels = np.array([[0.5, np.nan, 1.25], [np.inf, -np.inf, -0.75], [0, 1e-42, 3]], np.float32)
    depth = decode_image(image(pixels, encoding='32FC1', padding=padding, big=big), depth_scale=0.001)
    assert depth.tolist() == [[0.5, 0, 1.25], [0, 0, 0], [0, 0, 3]]


def test_decoding_leaves_the_message_as_it_was():
    message = image(np.array([[np.nan, 1]], np.float32), encoding='32FC1', buffer=bytearray)
    before = bytes(message.data)
    decode_image(message)[:] = 7
    assert bytes(message.data) == before


@pytest.mark.parametrize(('change', 'says'), [
    ({'encoding': 'rgb8'}, "'rgb8'.*16UC1, mono16, 32FC1"),
    ({'encoding': ''}, "''.*16UC1"),
    ({'encoding': 'two\nlines' * 99}, r"'two\\nlines[^']*is not depth"),
    ({'width': 0}, 'empty'),
    ({'height': 0}, 'empty'),
    ({'step': 129}, 'step is 129 .*130'),
    ({'step': 0}, 'step is 0'),
    ({'height': 49}, r'6240 bytes .* 130 x 49'),
    ({'data': b''}, '0 bytes'),
    ({'encoding': '32FC1'}, 'step is 130 .* takes 260'),
])
def test_a_bad_image_is_refused_in_one_sentence_that_begins_with_its_topic(units, change, says):
    message = image(units)
    vars(message).update(change)
    with pytest.raises(InputError, match=f'^/camera/depth: .*{says}') as error:
        decode_image(message, source='/camera/depth')
    assert '\n' not in str(error.value)


@pytest.mark.parametrize('scale', [0, -1, float('nan'), float('inf')])
def test_a_depth_scale_that_is_none_is_refused(units, scale):
    with pytest.raises(InputError, match='depth_scale'):
        decode_image(image(units), scale)
    with pytest.raises(InputError, match='depth_scale'):
        encode_compressed(units * np.float32(0.001), depth_scale=scale)


@pytest.mark.parametrize('form', [
    '16UC1; compressedDepth png', '16UC1; compressedDepth', '16UC1; compressedDepth ', '16UC1', '16UC1;compressedDepth',
    'mono16; compressedDepth png'])
def test_compressed_depth_png_in_all_spellings(units, form):
    # The header of old senders holds uninitialised floats.
    depth = decode_compressed(compressed(form, encode_png(units), struct.pack('<iff', 0, float('nan'), 1e30)))
    np.testing.assert_array_equal(depth, decode_image(image(units)))


@pytest.mark.parametrize('form', ['16UC1; png compressed ', '16UC1; png compressed', '16UC1'])
def test_png_without_header(units, form):
    for behind in (b'', b'\xff' * 9):
        depth = decode_compressed(compressed(form, encode_png(units) + behind, b''))
        np.testing.assert_array_equal(depth, decode_image(image(units)))


def test_tiff_as_kinect2_bridge_compresses_depth(units):
    depth = decode_compressed(compressed('16UC1; tiff compressed', tiff(units), b''))
    np.testing.assert_array_equal(depth, decode_image(image(units)))
    metres = np.where(units == 7, np.nan, units / 1000).astype(np.float32)
    depth = decode_compressed(compressed('32FC1; tiff compressed', tiff(metres), b''))
    np.testing.assert_array_equal(depth, np.nan_to_num(metres))


def test_other_codecs_are_refused():
    with pytest.raises(InputError, match="unknown codec 'jpg'"):
        encode_compressed(np.ones((4, 4), np.float32), 'jpg')


@pytest.mark.parametrize('codec', ['png', 'rvl'])
def test_what_is_compressed_comes_back(units, codec):
    depth = units * np.float32(0.001)
    form, data = encode_compressed(depth, codec)
    assert form == f'16UC1; compressedDepth {codec}'
    np.testing.assert_array_equal(decode_compressed(SimpleNamespace(format=form, data=data)), depth)


@pytest.mark.parametrize('encode', [encode_png, encode_rvl])
def test_inverse_depth_of_32fc1(encode):
    depth = np.linspace(0.3, 9, 600, dtype=np.float32).reshape(20, 30)
    depth[3, 4] = 0
    # As compressed_depth_image_transport quantises by default: depth_quantization 100, depth_max 10 m.
    a = 100.0 * 101.0
    b = 1 - a / 10
    with np.errstate(divide='ignore'):
        q = np.where(depth > 0, np.rint(a / depth + b), 0).astype(np.uint16)
    codec = 'png' if encode is encode_png else 'rvl'
    message = compressed(f'32FC1; compressedDepth {codec}', encode(q), struct.pack('<iff', 0, a, b))
    decoded = decode_compressed(message)
    assert decoded[3, 4] == 0
    near = (depth > 0) & (depth < 2)
    assert np.abs(decoded - depth)[near].max() < 3e-4
    assert np.abs(decoded - depth).max() < 5e-3
    message = compressed(message.format, encode(np.array([[1, 5, 7]], np.uint16)), struct.pack('<iff', 0, 10, 5))
    assert decode_compressed(message).tolist() == [[0, 0, 5]]  # behind infinity and at it there is no reading


@pytest.mark.parametrize(('message', 'says'), [
    (compressed('rgb8; jpeg compressed bgr8', b'\xff\xd8'), 'rgb8; jpeg'),
    (compressed('', b''), "format ''"),
    (compressed('16UC1; tiff compressed', tiff(np.ones((4, 4), np.float32)), b''), 'TIFF of 4x4 .* 16 bits'),
    (compressed('32FC1; tiff compressed', tiff(np.ones((4, 4), np.uint16)), b''), 'TIFF of 4x4 .* 32 bits'),
    (compressed('16UC1; tiff compressed', tiff(np.ones((4, 4, 3), np.uint16)), b''), 'not of one channel'),
    (compressed('16UC1; tiff compressed', tiff(np.ones((4, 4), np.uint16))[:30], b''), 'not a TIFF'),
    (compressed('16UC1; tiff compressed', encode_png(np.ones((4, 4), np.uint16)), b''), 'not a TIFF'),
    (compressed('16UC1; tiff compressed', b'II*\0' + struct.pack(
        '<IH' + 2 * 'HHII', 8, 2, 256, 4, 1, 1 << 30, 257, 4, 1, 1 << 30), b''), 'claims'),
    (compressed('16UC1; compressedDepth png', b''), 'not a PNG'),
    (compressed('16UC1; compressedDepth png', b'', b''), 'not a PNG'),
    (compressed('16UC1; compressedDepth png', encode_png(np.ones((4, 4), np.uint16))[:20]), 'not a PNG'),
    (compressed('16UC1; compressedDepth rvl', b'\1\0'), 'RVL'),
    (compressed('16UC1; compressedDepth rvl', struct.pack('<II', 1 << 31, 1 << 31)), 'claims'),
    (compressed('16UC1; compressedDepth rvl', struct.pack('<II', 1 << 13, 1 + (1 << 11))), 'claims 8192x2049'),
    (compressed('16UC1; compressedDepth rvl', struct.pack('<II', 0, 5)), 'claims 0x5'),
    (compressed('16UC1; compressedDepth rvl', struct.pack('<IIIII', 1, 1, *[0x88888888] * 2, 0)), 'without end'),
    (compressed('16UC1; compressedDepth rvl', struct.pack('<III', 1, 1, 0x01100000)), 'of more than 16 bits'),  # -1
    (compressed('16UC1; compressedDepth rvl', struct.pack('<III', 1, 1, 0x01888884)), 'of more than 16 bits'),  # 65536
    (compressed('16UC1; compressedDepth rvl', struct.pack('<II', 9, 9)), 'RVL'),
    (compressed('16UC1; compressedDepth rvl', struct.pack('<II', 9, 9) + b'\xff' * 40), 'RVL'),
    (compressed('16UC1; compressedDepth png', cv2.imencode('.png', np.zeros((4, 4), np.uint8))[1].tobytes()), '8 bits'),
    (compressed('16UC1; compressedDepth png', encode_png(np.zeros((4, 4, 3), np.uint16))), '16 bits per colour'),
    (compressed('32FC1; compressedDepth png', encode_png(np.ones((4, 4), np.uint16))), 'A=0.0'),
    (compressed('32FC1; compressedDepth png', encode_png(np.ones((4, 4), np.uint16)),
                struct.pack('<iff', 0, 100, float('nan'))), 'A=100.0, B=nan'),
    (compressed('32FC1; compressedDepth png', encode_png(np.ones((4, 4), np.uint16)), b''), 'header'),
])
def test_bad_compressed_messages_are_refused_in_one_sentence(message, says):
    with pytest.raises(InputError, match=f'^/depth: .*{says}') as error:
        decode_compressed(message, source='/depth')
    assert '\n' not in str(error.value)


def test_a_png_that_claims_a_huge_size_gets_no_memory(units):
    png = bytearray(encode_png(units))
    png[16:24] = struct.pack('>II', 100_000, 100_000)
    with pytest.raises(InputError, match='claims 100000x100000'):
        decode_compressed(compressed('16UC1; compressedDepth png', bytes(png)))


def test_a_png_chunk_that_claims_a_huge_length_gets_no_memory(units, monkeypatch):
    """Found by fuzzing: OpenCV takes 4 GB for it before it notices."""
    png = bytearray(encode_png(units))
    at = png.index(b'IDAT') - 4
    png[at:at + 4] = b'\xf0\0\0\0'
    monkeypatch.setattr(cv2, 'imdecode', pytest.fail)
    with pytest.raises(InputError, match='damaged'):
        decode_compressed(compressed('16UC1; compressedDepth png', bytes(png)))


@pytest.mark.parametrize('pixels', [np.zeros((1 << 13 | 1, 1), np.uint16), np.zeros((1, 1 << 13 | 1), np.uint16)])
def test_a_long_thin_image_is_refused_before_it_takes_minutes(pixels):
    """Found by fuzzing: the search for a hand thins out columns, and there was one of 16 million pixels."""
    size = f'claims {pixels.shape[1]}x{pixels.shape[0]} pixels'
    with pytest.raises(InputError, match=size):
        decode_image(image(pixels))
    for codec, payload in (('png', encode_png(pixels)), ('rvl', encode_rvl(pixels))):
        with pytest.raises(InputError, match=size):
            decode_compressed(compressed(f'16UC1; compressedDepth {codec}', payload))


@pytest.mark.parametrize('keep', [0.1, 0.5, 0.99])
@pytest.mark.parametrize('codec', ['png', 'rvl'])
def test_a_compressed_image_that_was_cut_short_never_gives_depth(units, codec, keep):
    form, data = encode_compressed(units * np.float32(0.001), codec)
    with pytest.raises(InputError):
        decode_compressed(SimpleNamespace(format=form, data=data[:int(len(data) * keep)]))


def test_rvl_of_a_known_stream():
    """Worked out by hand from the paper: 2 zeros, 2 others (+5 -> zigzag 10, -1 -> zigzag 1), 1 zero, 0 others."""
    nibbles = [2, 2, 8 | 2, 1, 1, 1, 0]  # 10 = 2 + 1 * 8
    word = sum(nibble << 28 - 4 * i for i, nibble in enumerate(nibbles))
    data = struct.pack('<III', 5, 1, word)
    assert decode_rvl(data).tolist() == [[0, 0, 5, 4, 0]]
    assert encode_rvl(np.array([[0, 0, 5, 4, 0]], np.uint16)) == data


@settings(deadline=None)
@given(UNITS)
def test_any_order_of_bytes_in_memory_is_encoded_alike(units):
    for encode in (encode_png, encode_rvl):
        assert encode(units.astype('>u2')) == encode(units.astype('<u2')) == encode(np.asfortranarray(units))


@settings(deadline=None)
@given(UNITS)
def test_rvl_is_lossless(units):
    np.testing.assert_array_equal(decode_rvl(encode_rvl(units)), units)


def test_what_does_not_fit_into_sixteen_bits_is_no_reading():
    depth = np.array([[0, 0.0004, 0.0006, 65.535, 65.536, 1e9, np.nan]], np.float32)
    assert to_units(depth).tolist() == [[0, 0, 1, 65535, 0, 0, 0]]


def test_pngs_are_read_in_metres_or_refused_by_name(tmp_path, units):
    path = tmp_path / 'depth.png'
    cv2.imwrite(str(path), units)
    np.testing.assert_allclose(read_png(path, 0.002), units * 0.002, rtol=1e-6)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(InputError, match=r'depth\.png: .*damaged'):
        read_png(path)
    path.write_text('no picture')
    with pytest.raises(InputError, match=r'depth\.png: .*not a PNG'):
        read_png(path)
    with pytest.raises(InputError, match=r'missing\.png: .*cannot be read'):
        read_png(tmp_path / 'missing.png')
    with pytest.raises(InputError, match='cannot be read'):
        read_png(tmp_path)


def test_real_frames_are_read_in_metres(shared_data):
    kinect = read_png(shared_data / 'frames/kinect2/00000010.png')
    assert kinect.shape == (424, 512) and 0.5 < kinect[kinect > 0].min() < 0.7
    sr305 = read_png(shared_data / 'frames/sr305/20210326-230536/30.png', 0.000125)
    assert sr305.shape == (480, 640) and 0.4 < np.percentile(sr305[sr305 > 0], 1) < 0.7
    with pytest.raises(InputError, match=r'kinect2_8bit_379\.png: .*8 bits'):
        read_png(shared_data / 'frames/must_reject/kinect2_8bit_379.png')

"""What the angles of the fingers promise: anatomy's names, signs and zeros, wherever the hand is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hand_pose_ros.angles import ANGLES, finger_angles
from hand_pose_ros.errors import InputError
from hand_pose_ros.skeleton import FINGERS, HAND21
from hand_pose_ros.synthetic.hand import rest_pose
from hand_pose_ros.synthetic.kinematics import INDEX, forward
from hand_pose_ros.synthetic.shapes import mean_shape

DEGREES = np.pi / 180
LIMITS = {'mcp_flexion': (-20, 90), 'mcp_abduction': (-15, 15), 'pip_flexion': (-5, 100), 'dip_flexion': (-10, 80)}


def flat_hand() -> np.ndarray:
    """(21, 3) a right hand in the plane z = 0, palm towards +z, all fingers parallel to y, the thumb too."""
    joints = np.zeros((21, 3))
    for digit, x in enumerate((0.05, 0.03, 0.0, -0.02, -0.04)):
        for bone in range(4):
            joints[1 + 4 * digit + bone] = (x, (0.02 if digit == 0 else 0.09) + 0.03 * bone, 0)
    return joints


def bent(joint: str, axis: str, degrees: float) -> np.ndarray:
    """The flat hand with everything beyond a joint turned about an axis through it."""
    joints = flat_hand()
    at = HAND21.joint_names.index(joint)
    end = 1 + 4 * ((at - 1) // 4) + 4
    joints[at:end] = Rotation.from_euler(axis, degrees, degrees=True).apply(joints[at:end] - joints[at]) + joints[at]
    return joints


def in_degrees(joints: np.ndarray, side: str = 'right') -> dict[str, float]:
    return dict(zip(ANGLES, finger_angles(joints, side) / DEGREES, strict=True))


def test_a_flat_hand_is_zero() -> None:
    assert finger_angles(flat_hand(), 'right') == pytest.approx(np.zeros(20), abs=1e-9)


@pytest.mark.parametrize('joint, axis, degrees, angle, expected', [
    ('index_mcp', 'x', 40, 'index_mcp_flexion', 40), ('ring_mcp', 'x', -15, 'ring_mcp_flexion', -15),
    ('pinky_pip', 'x', 90, 'pinky_pip_flexion', 90), ('middle_dip', 'x', -10, 'middle_dip_flexion', -10),
    ('index_mcp', 'z', -12, 'index_mcp_abduction', 12), ('middle_mcp', 'z', -12, 'middle_mcp_abduction', 12),
    ('ring_mcp', 'z', 12, 'ring_mcp_abduction', 12), ('pinky_mcp', 'z', 12, 'pinky_mcp_abduction', 12),
    ('thumb_cmc', 'z', -45, 'thumb_cmc_flexion', -45), ('thumb_cmc', 'x', 30, 'thumb_cmc_abduction', 30),
    ('thumb_mcp', 'z', 35, 'thumb_mcp_flexion', 35), ('thumb_ip', 'z', 50, 'thumb_ip_flexion', 50),
    ('thumb_ip', 'z', -20, 'thumb_ip_flexion', -20)])
def test_one_bend_is_one_angle(joint: str, axis: str, degrees: float, angle: str, expected: float) -> None:
    angles = in_degrees(bent(joint, axis, degrees))
    assert angles.pop(angle) == pytest.approx(expected, abs=1e-6)
    assert np.abs(list(angles.values())) == pytest.approx(0, abs=1e-6)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(0.5, 2))
def test_neither_place_nor_size_nor_side_matters(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    joints = flat_hand() + rng.normal(0, 0.01, (21, 3))
    expected = finger_angles(joints, 'right')
    moved = scale * Rotation.random(random_state=seed % 2**31).apply(joints) + rng.normal(0, 1, 3)
    assert finger_angles(moved, 'right') == pytest.approx(expected, abs=1e-6)
    mirrored = moved * rng.permutation([-1, 1, 1])
    assert finger_angles(mirrored, 'left') == pytest.approx(expected, abs=1e-6)
    assert finger_angles(np.stack([moved, joints]), 'right')[0] == pytest.approx(expected, abs=1e-6)


def synthetic(**degrees: float) -> np.ndarray:
    """Joints of the synthetic hand in its rest pose, with some of its angles set."""
    pose = rest_pose()
    pose[10:] = 0
    for name, value in degrees.items():
        pose[INDEX[name]] = value * DEGREES
    _, _, joints = forward(mean_shape(), pose[None].float(), rest_pose())
    return joints[0].double().numpy()


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_the_angles_of_the_synthetic_hand_come_back(data: st.DataObject) -> None:
    given_ = {f'{finger}_{angle}': data.draw(st.floats(*limits), label=f'{finger}_{angle}')
              for finger in FINGERS[1:] for angle, limits in LIMITS.items()}
    angles = in_degrees(synthetic(**given_))
    for angle in LIMITS:  # the middle finger defines the palm there, too
        assert angles[f'middle_{angle}'] == pytest.approx(given_[f'middle_{angle}'], abs=1.5), angle
    for finger in FINGERS[1:]:
        for angle in ('pip_flexion', 'dip_flexion'):
            assert angles[f'{finger}_{angle}'] == pytest.approx(given_[f'{finger}_{angle}'], abs=2.5), (finger, angle)


@pytest.mark.parametrize('finger', FINGERS[1:])
def test_spreading_and_flexing_change_the_angles_by_as_much(finger: str) -> None:
    """The synthetic fingers are not parallel at abduction 0, as ours are: differences are the same all the same."""
    zero = in_degrees(synthetic())
    for name, degrees in ((f'{finger}_mcp_abduction', 14), (f'{finger}_mcp_flexion', 30)):
        assert in_degrees(synthetic(**{name: degrees}))[name] - zero[name] == pytest.approx(degrees, abs=1.5), name


@settings(max_examples=40, deadline=None)
@given(radial=st.floats(0, 55), palmar=st.floats(-5, 50), mcp=st.floats(12, 60), ip=st.floats(12, 80))
def test_the_thumb_of_the_synthetic_hand_comes_back(radial: float, palmar: float, mcp: float, ip: float) -> None:
    angles = in_degrees(synthetic(thumb_cmc_radial=radial, thumb_cmc_palmar=palmar, thumb_mcp_flexion=mcp,
                                  thumb_ip_flexion=ip, thumb_mcp_abduction=0))
    assert angles['thumb_cmc_flexion'] == pytest.approx(-radial, abs=2)
    assert angles['thumb_cmc_abduction'] == pytest.approx(palmar, abs=2)
    assert angles['thumb_mcp_flexion'] == pytest.approx(mcp, abs=0.1)
    assert angles['thumb_ip_flexion'] == pytest.approx(ip, abs=0.1)
    assert in_degrees(synthetic(thumb_cmc_radial=radial, thumb_cmc_palmar=palmar,
                                thumb_ip_flexion=-20))['thumb_ip_flexion'] == pytest.approx(-20, abs=0.1)


@settings(max_examples=40, deadline=None)
@given(radial=st.floats(0, 55), palmar=st.floats(-5, 50), abduction=st.floats(-18, 18))
def test_the_angles_of_the_thumb_do_not_jump(radial: float, palmar: float, abduction: float) -> None:
    angles = np.array([[in_degrees(synthetic(
        thumb_cmc_radial=radial, thumb_cmc_palmar=palmar, thumb_mcp_flexion=mcp, thumb_mcp_abduction=abduction))[name]
        for name in ('thumb_mcp_flexion', 'thumb_ip_flexion')] for mcp in np.arange(-20, 60, 2.0)])
    # A degree of flexion turns the direction of a bend of 10 degrees by 6, and with it what counts of it.
    assert np.abs(np.diff(angles[:, 0])).max() < 8
    assert np.abs(np.diff(angles[:, 1])).max() < 8


def test_a_hand_without_extent_has_no_angles_but_no_nan_either() -> None:
    assert (finger_angles(np.zeros((21, 3)), 'right') == 0).all()


@pytest.mark.parametrize('bone', range(3))
def test_a_bone_without_length_gives_no_angle_of_its_own_or_against_it(bone: int) -> None:
    joints = synthetic(index_mcp_flexion=20, index_mcp_abduction=10, index_pip_flexion=30, index_dip_flexion=40)
    joints[6 + bone:9] += joints[5 + bone] - joints[6 + bone]  # what is behind it goes along
    angles = in_degrees(joints)
    without = (('mcp_flexion', 'mcp_abduction', 'pip_flexion', 'dip_flexion'), ('pip_flexion', 'dip_flexion'),
               ('dip_flexion',))[bone]
    for angle in ('mcp_flexion', 'mcp_abduction', 'pip_flexion', 'dip_flexion'):
        assert (angles[f'index_{angle}'] == 0) == (angle in without), angle


def test_wrong_input_is_named() -> None:
    with pytest.raises(InputError, match=r"'unknown'"):
        finger_angles(flat_hand(), 'unknown')
    with pytest.raises(InputError, match=r'\(14, 3\)'):
        finger_angles(np.zeros((14, 3)), 'left')

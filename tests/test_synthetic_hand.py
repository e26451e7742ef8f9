"""The synthetic hand: joints exact, skin closed and around the bones, shapes as measured, poses as hands move."""

import math
from itertools import combinations, pairwise, product

import numpy as np
import pytest
import torch

from hand_pose_ros.errors import InputError
from hand_pose_ros.skeleton import HAND21
from hand_pose_ros.synthetic.contact import overlaps
from hand_pose_ros.synthetic.hand import HandModel
from hand_pose_ros.synthetic.kinematics import BONES, INDEX, POSE, forward
from hand_pose_ros.synthetic.poses import LIMITS, sample_poses
from hand_pose_ros.synthetic.rig import Rig
from hand_pose_ros.synthetic.rng import Random
from hand_pose_ros.synthetic.shapes import mean_shape, sample_shapes

JOINT = {name: i for i, name in enumerate(HAND21.joint_names)}
FINGERS = ('index', 'middle', 'ring', 'pinky')


@pytest.fixture(scope='module')
def model():
    return HandModel()


def pose(**degrees):
    """One pose: the named angles in degrees; 'mcp_flexion' and the like set all four fingers."""
    angles = torch.zeros(1, len(POSE))
    for name, value in degrees.items():
        for full in [name] if name in INDEX else [f'{finger}_{name}' for finger in FINGERS]:
            angles[0, INDEX[full]] = math.radians(value)
    return angles


OPEN = {'thumb_cmc_radial': 45, 'thumb_cmc_palmar': 25, 'thumb_cmc_roll': 70}
FIST = {'mcp_flexion': 75, 'pip_flexion': 95, 'dip_flexion': 50, 'thumb_cmc_radial': 22, 'thumb_cmc_palmar': 48,
        'thumb_cmc_roll': 98, 'thumb_mcp_flexion': 34, 'thumb_ip_flexion': 45}


def angle(a, b):
    """Degrees between vectors (..., 3)."""
    return torch.rad2deg(torch.acos((torch.nn.functional.normalize(a, dim=-1)
                                     * torch.nn.functional.normalize(b, dim=-1)).sum(-1).clamp(-1, 1)))


def winding(vertices, faces, points):
    """How often the mesh (V, 3), (F, 3) goes around each point (N, 3): 1 inside, 0 outside (solid angles)."""
    a, b, c = (vertices[faces[:, i]][None] - points[:, None] for i in range(3))
    la, lb, lc = a.norm(dim=-1), b.norm(dim=-1), c.norm(dim=-1)
    top = (a * torch.linalg.cross(b, c)).sum(-1)
    bottom = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return 2 * torch.atan2(top, bottom).sum(-1) / (4 * math.pi)


def reach(vertices, faces, point, direction):
    """How far it is from a point inside the mesh (V, 3), (F, 3) to where a ray leaves it."""
    a, b, c = (vertices[faces[:, i]] - point for i in range(3))
    inside = torch.stack([torch.linalg.cross(u, v) @ direction for u, v in ((a, b), (b, c), (c, a))]).amin(0) >= 0
    normal = torch.linalg.cross(b - a, c - a)
    return ((a * normal).sum(-1) / (normal @ direction))[inside].max().item()


def volume(vertices, faces):
    a, b, c = (vertices[..., faces[:, i], :].double() for i in range(3))
    return (a * torch.linalg.cross(b, c)).sum((-1, -2)) / 6


# Joints -------------------------------------------------------------------------------------------------------------

def test_a_straight_finger_ends_at_the_sum_of_its_bones(model):
    shape = mean_shape('man')
    _, joints = model(shape, pose(**OPEN))
    middle = joints[0, [JOINT[f'middle_{j}'] for j in ('mcp', 'pip', 'dip', 'tip')]]
    along = torch.cat([shape.roots[0, 2, 1:2], shape.roots[0, 2, 1] + shape.segments[0, 2].cumsum(0)])
    expected = torch.stack([torch.zeros(4), along, torch.zeros(4)], 1)
    torch.testing.assert_close(middle, expected, atol=1e-7, rtol=0)
    assert (joints[0, 0] == 0).all()  # the wrist is the origin


def test_each_joint_turns_what_lies_beyond_it(model):
    shape = mean_shape()
    proximal, middle, distal = shape.segments[0, 2]
    root = shape.roots[0, 2]
    for angles, expected in (
            ({'middle_mcp_flexion': 90}, [0, 0, proximal + middle + distal]),
            ({'middle_pip_flexion': 90}, [0, proximal, middle + distal]),
            ({'middle_dip_flexion': 90}, [0, proximal + middle, distal]),
            ({'middle_mcp_flexion': 90, 'middle_pip_flexion': 90}, [0, -middle - distal, proximal])):
        _, joints = model(shape, pose(**angles))
        torch.testing.assert_close(joints[0, JOINT['middle_tip']], root + torch.tensor(expected), atol=1e-6, rtol=0)


def test_bones_keep_their_length_in_every_pose(model):
    rng = Random(torch.arange(50))
    shape = sample_shapes(rng)
    _, joints = model(shape, sample_poses(rng))
    digits = joints[:, 1:].reshape(-1, 5, 4, 3)
    torch.testing.assert_close((digits[:, :, 1:] - digits[:, :, :-1]).norm(dim=-1), shape.segments, atol=1e-6, rtol=0)


def test_it_is_a_right_hand(model):
    """Seen from the palm with the fingers up, the thumb of a right hand is on the right."""
    vertices, flat = model(mean_shape(), pose(**OPEN))
    _, bent = model(mean_shape(), pose(**OPEN, mcp_flexion=80))
    flat, bent = flat[0], bent[0]
    fingers = flat[JOINT['middle_mcp']] - flat[JOINT['wrist']]
    thumb = flat[JOINT['thumb_tip']] - flat[JOINT['pinky_mcp']]
    palm = bent[JOINT['middle_tip']] - flat[JOINT['middle_tip']]  # fingers bend towards the palm
    assert torch.dot(torch.linalg.cross(thumb, fingers), palm) > 0
    assert palm[2] > 0 and thumb[0] > 0 and fingers[1] > 0
    # The skin says the same: the fleshy side of the hand, with the ball of the thumb, is the palm.
    hand = vertices[0][model.vertex_part != 6]
    assert hand[:, 2].max() > -2 * hand[:, 2].min()


def test_positive_angles_turn_the_way_their_names_say(model):
    def tip(finger, **degrees):
        return model(mean_shape(), pose(**OPEN | degrees))[1][0, JOINT[f'{finger}_tip']]

    assert tip('index', index_mcp_abduction=15)[0] > tip('index')[0]
    assert tip('pinky', pinky_mcp_abduction=15)[0] < tip('pinky')[0]
    assert tip('thumb', thumb_cmc_radial=60)[1] < tip('thumb')[1]
    assert tip('thumb', thumb_cmc_palmar=50)[2] > tip('thumb')[2]
    assert tip('pinky', pinky_cmc_flexion=15)[2] > tip('pinky')[2]
    bent = model(mean_shape(), pose(**OPEN, wrist_flexion=40))[0][0][model.vertex_part == 6]
    turned = model(mean_shape(), pose(**OPEN, wrist_deviation=20))[0][0][model.vertex_part == 6]
    assert bent[:, 2].mean() > 0.05  # the hand bends towards the palm: the forearm comes to the palm's side
    assert turned[:, 0].mean() > 0.02  # and towards the thumb


# Skin ---------------------------------------------------------------------------------------------------------------

def test_skin_is_closed_and_faces_outwards(model):
    faces = model.faces
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()
    directed = {tuple(edge) for edge in edges}
    assert len(directed) == len(edges), 'an edge is used twice in the same direction'
    assert all((b, a) in directed for a, b in directed), 'an edge has only one triangle'
    vertices, _ = model(mean_shape('man'), pose(**OPEN))
    count = vertices.shape[1]
    assert count - len(edges) // 2 + len(faces) == 2, 'the skin is not one ball without handles'
    assert 1500 <= count <= 3000
    assert sorted(set(model.vertex_part.tolist())) == list(range(7))
    hand = vertices[0][model.vertex_part != 6]
    assert 0.8e-3 < volume(vertices, faces).item() < 1.8e-3  # a hand of 0.4 litres and most of a forearm
    assert hand[:, 1].max().item() == pytest.approx(0.183, abs=0.003)


def test_joints_lie_inside_the_skin(model):
    rng = Random(torch.arange(12))
    vertices, joints = model(sample_shapes(rng), sample_poses(rng))
    for skin, points in zip(vertices, joints, strict=True):
        assert (winding(skin, model.faces, points) > 0.9).all()


def test_tips_are_a_fingertip_radius_inside_the_end(model):
    shape = mean_shape('man')
    vertices, joints = model(shape, pose(**OPEN, mcp_abduction=4))
    for digit, finger in enumerate(('thumb', *FINGERS)):
        tip, before = joints[0, JOINT[f'{finger}_tip']], joints[0, JOINT[f'{finger}_tip'] - 1]
        along = torch.nn.functional.normalize(tip - before, dim=0)
        beyond = ((vertices[0][model.vertex_part == digit] - tip) @ along).max().item()
        assert 0.0045 < beyond < 0.0095, finger


def test_skin_is_as_thick_as_the_measures_say_straight_and_bent(model):
    """Half-way up each phalanx, and around the joint of a finger bent by 90 degrees (no candy wrapper)."""
    shape = mean_shape('man')
    for bend in (0, 90):
        vertices, joints = model(shape, pose(**OPEN, pip_flexion=bend))
        for digit in range(1, 5):
            skin = vertices[0][model.vertex_part == digit]
            a, b, c = joints[0, 4 * digit + 1], joints[0, 4 * digit + 2], joints[0, 4 * digit + 3]
            for start, end, radius in ((a, b, shape.radii[0, digit, 0]), (b, c, shape.radii[0, digit, 1])):
                along = torch.nn.functional.normalize(end - start, dim=0)
                offset = skin - (start + end) / 2
                ring = offset[(offset @ along).abs() < 0.004]
                around = (ring - (ring @ along)[:, None] * along).norm(dim=1)
                thickness = around[around < 2 * radius].mean()
                assert 0.85 * radius < thickness < 1.2 * radius, (digit, bend)
            knuckle = (skin - b).norm(dim=1).min()
            assert 0.6 * shape.radii[0, digit, 1] < knuckle < 1.2 * shape.radii[0, digit, 1], (digit, bend)


def test_the_flesh_is_on_the_side_of_the_palm(model):
    """How much thicker the hand is between bone and palm than between bone and back, at the least."""
    shape, angles = mean_shape(), pose(**OPEN)
    skin, joints = (part[0] for part in model(shape, angles))
    rotations, origins = (part[0] for part in forward(shape, angles, model.rest)[:2])
    palmar = {bone: rotation[:, 2] for bone, rotation in zip(BONES, rotations, strict=True)}
    knuckles = joints[5::4]
    places = [('wrist', joints[0], palmar['carpus'], 1.1),
              ('heel below the thumb', torch.tensor([0.020, 0.030, 0]), palmar['carpus'], 3),
              ('heel below the little finger', torch.tensor([-0.020, 0.025, 0]), palmar['carpus'], 1.7)]
    for finger, knuckle in zip(FINGERS, knuckles, strict=True):
        bone = f'{finger}_metacarpal'
        places += [(bone, (origins[BONES.index(bone)] + knuckle) / 2, palmar[bone], 1.4),
                   (f'{finger} knuckle', knuckle, palmar[bone], 1.25)]
    places += [('web', (a + b) / 2, palmar['carpus'], 1.25) for a, b in pairwise(knuckles)]
    for digit, finger in enumerate(('thumb', *FINGERS)):
        for i in (1, 2, 3):
            start, end = joints[4 * digit + i], joints[4 * digit + i + 1]
            bone = f'{finger}_bone{i}'
            places.append((bone, (start + end) / 2, palmar[bone], 1.05 if i == 3 else 1.1))
    for place, point, direction, least in places:
        palm, back = (reach(skin, model.faces, point, way) for way in (direction, -direction))
        assert palm > least * back, place
    assert winding(skin, model.faces, (joints[2] + knuckles[:1]) / 2) > 0.9, 'no web between thumb and index finger'


@pytest.mark.parametrize('digit', range(5))
def test_a_bent_finger_drags_no_other_but_at_the_web(model, digit):
    still, bent = (model(mean_shape(), pose(**OPEN, **{f'{("thumb", *FINGERS)[digit]}_mcp_flexion': degrees}))[0][0]
                   for degrees in (0, 60))
    moved = (bent - still).norm(dim=1)
    for other in {*range(5)} - {digit}:
        web = digit * other > 0 and abs(digit - other) == 1
        assert moved[model.vertex_part == other].max() < (0.012 if web else 0.0002), other


def test_no_bend_costs_the_hand_its_flesh(model):
    shape = mean_shape()
    opened, closed = (volume(model(shape, angles)[0], model.faces).item() for angles in (pose(**OPEN), pose(**FIST)))
    assert closed == pytest.approx(opened, rel=0.05)


def test_a_hand_is_the_same_in_any_batch(model):
    def hands(seeds):
        rng = Random(seeds)
        shape, angles = sample_shapes(rng.fork(1)), sample_poses(rng.fork(2))
        return (angles, *model(shape, angles))

    together = hands(torch.arange(40))
    for first, last in ((0, 1), (7, 10), (3, 40)):
        for whole, part in zip(together, hands(torch.arange(first, last)), strict=True):
            assert torch.equal(whole[first:last], part)


# Shapes -------------------------------------------------------------------------------------------------------------

def test_shapes_are_spread_as_people_are():
    """The adult mean and the correlations of the ACOPLA95 survey and of Buryanov and Kotiuk 2010; children below."""
    shape = sample_shapes(Random(torch.arange(10000)))
    length, breadth = shape.hand_length.numpy(), shape.hand_breadth.numpy()
    adults = length > 0.150
    assert length[adults].mean() == pytest.approx(0.174, abs=0.003)
    assert breadth[adults].mean() == pytest.approx(0.0795, abs=0.002)
    assert np.percentile(length, 1) < 0.135 and 0.198 < np.percentile(length, 99) < 0.212
    assert 0.75 < np.corrcoef(length, breadth)[0, 1] < 0.97
    end = shape.roots[:, 2, 1] + shape.segments[:, 2].sum(1) + shape.finger_ends[:, 2]
    torch.testing.assert_close(end, shape.hand_length, atol=1e-6, rtol=0)
    scatter = (shape.segments[:, :, :2] / shape.hand_length[:, None, None]).std(0) / (
        shape.segments[:, :, :2] / shape.hand_length[:, None, None]).mean(0)
    assert (scatter > 0.03).all() and (scatter < 0.08).all()  # proportions differ by 5-8 % between people
    assert (shape.segments > 0.006).all() and (shape.radii > 0.003).all()


@pytest.mark.parametrize(('sex', 'length', 'proximal'), [('man', 0.183, 0.0498), ('woman', 0.166, 0.0452)])
def test_mean_hands_have_the_published_measures(sex, length, proximal):
    shape = mean_shape(sex)
    assert shape.hand_length.item() == pytest.approx(length)
    assert shape.segments[0, 2, 0].item() == pytest.approx(proximal, rel=0.02)  # joint centres, middle finger


# Poses --------------------------------------------------------------------------------------------------------------

def test_poses_keep_to_the_limits_and_out_of_themselves():
    angles = sample_poses(Random(torch.arange(500)))
    assert angles.shape == (500, len(POSE)) and angles.isfinite().all()
    assert (angles >= LIMITS[:, 0] - 1e-6).all() and (angles <= LIMITS[:, 1] + 1e-6).all()
    assert overlaps(angles).max() == 0
    others = overlaps(angles, sample_shapes(Random(torch.arange(500))))  # hands of other proportions
    assert others.flatten(1).amax(1).quantile(0.99) < 0.006


def test_overlaps_are_seen():
    """A finger straight through the palm, and two fingers crossing, are reported as deep as they are."""
    through = overlaps(pose(**OPEN, middle_mcp_flexion=92, middle_pip_flexion=130, middle_dip_flexion=60))
    assert through[0, 2, 5] > 0.002
    thumb = overlaps(pose(**OPEN | {'thumb_cmc_radial': 0, 'thumb_cmc_palmar': -10}))
    assert thumb[0, 0, 5] > 0.002
    crossed = overlaps(pose(**OPEN, index_mcp_abduction=-14, middle_mcp_abduction=14))
    assert crossed[0, 1, 2] > 0.004
    assert overlaps(pose(**OPEN, index_mcp_abduction=20, ring_mcp_abduction=15, pinky_mcp_abduction=30)).max() == 0


def test_bones_of_different_digits_keep_their_flesh_apart():
    """Told from the joints alone; fingers may touch where they grow together."""
    shape = mean_shape()
    joints = forward(shape, sample_poses(Random(torch.arange(600))), torch.zeros(len(POSE)))[2]
    digits = joints[:, 1:].reshape(-1, 5, 4, 3)
    along = torch.linspace(0, 1, 9)[:, None]
    bones = digits[:, :, :3, None] * (1 - along) + digits[:, :, 1:, None] * along  # (B, 5, 3, 9, 3)
    for a, b in combinations(range(5), 2):
        for i, j in product(range(3), repeat=2):
            if i + j == 0:
                continue
            apart = torch.cdist(bones[:, a, i], bones[:, b, j]).amin((1, 2))
            first = (0.78 if a == i == 0 else 0.93) * shape.radii[0, a, i]
            deep = first + 0.93 * shape.radii[0, b, j] - apart
            assert deep.max() < (0.0025 if a == 0 else 0.005), (a, i, b, j)


def test_fingers_spread_and_thumbs_stand_off_as_far_as_real_ones(model):
    angles = sample_poses(Random(torch.arange(4000)))
    joints = forward(mean_shape(), angles, model.rest)[2]
    bend = torch.rad2deg(angles[:, [INDEX[f'{f}_{j}_flexion'] for f in FINGERS for j in ('mcp', 'pip')]])
    flat = joints[(bend < 25).all(1)]
    finger = {f: flat[:, JOINT[f'{f}_tip']] - flat[:, JOINT[f'{f}_mcp']] for f in FINGERS}
    assert angle(finger['index'], finger['pinky']).quantile(0.85) > 60
    for near, far in pairwise(FINGERS):
        assert angle(finger[near], finger[far]).quantile(0.85) > 18
    thumb = angle(flat[:, JOINT['thumb_tip']] - flat[:, JOINT['thumb_mcp']], finger['middle'])
    assert thumb.quantile(0.85) > 75 and thumb.max() > 90
    assert 0.08 < len(flat) / 4000 < 0.4


def test_pinches_meet(model):
    """Of many poses some bring the thumb and each finger together, pulp to pulp."""
    joints = forward(mean_shape(), sample_poses(Random(torch.arange(3000))), model.rest)[2]
    thumb = joints[:, JOINT['thumb_tip']]
    for finger, share in (('index', 0.03), ('middle', 0.01), ('ring', 0.002), ('pinky', 0.0005)):
        assert ((joints[:, JOINT[f'{finger}_tip']] - thumb).norm(dim=1) < 0.017).float().mean() > share, finger


def test_real_hand_poses_are_covered(shared_data):
    """Nine of ten poses of a recorded bank have one of ours within 10 degrees (knuckles and middle joints)."""
    from scipy.spatial import cKDTree
    from scipy.spatial.transform import Rotation

    bank = np.loadtxt(shared_data / 'hand_models/intel_pose_bank/animbank.pose').reshape(-1, 17, 7)
    turn = [Rotation.from_quat(bank[:, bone, 3:]) for bone in range(17)]
    recorded = np.stack([np.degrees((turn[a].inv() * turn[b]).as_rotvec()[:, 0])
                         for bone in (5, 8, 11, 14) for a, b in ((1, bone), (bone, bone + 1))], 1)
    angles = sample_poses(Random(torch.arange(6000)))
    ours = np.degrees(angles[:, [INDEX[f'{f}_{j}_flexion'] for f in FINGERS for j in ('mcp', 'pip')]].numpy())
    recorded[:, ::2] -= 10  # their palm leans by about this against our metacarpals
    distance = cKDTree(ours).query(recorded)[0] / math.sqrt(8)
    assert np.percentile(distance, 90) < 10


# A rig from a file ----------------------------------------------------------------------------------------------------

@pytest.fixture(scope='module')
def rigs(shared_data):
    folder = shared_data / 'hand_models/webxr_generic_hand'
    return {side: Rig(folder / f'{side}.glb') for side in ('right', 'left')}


def test_rig_has_its_own_measures_and_takes_those_asked_for(rigs):
    rig = rigs['right']
    # Bones of this hand, measured between its joints (mm): index and middle finger, proximal and middle.
    measured = torch.tensor([[45.3, 24.3], [46.9, 27.5]])
    torch.testing.assert_close(rig.shape.segments[0, 1:3, :2] * 1e3, measured, atol=0.1, rtol=0)
    shape = mean_shape('woman')
    vertices, joints = rig(shape, pose(**OPEN))
    torch.testing.assert_close(joints[0, JOINT['middle_tip'], 1], shape.roots[0, 2, 1] + shape.segments[0, 2].sum())
    assert vertices[0, :, 1].max().item() == pytest.approx(0.166, abs=0.004)
    assert volume(vertices, rig.faces) > 0


def test_rig_moves_as_the_model_does(rigs, model):
    rng = Random(torch.arange(12))
    shape, angles = sample_shapes(rng), sample_poses(rng)
    ours = model(shape, angles)[1]
    for side, rig in rigs.items():  # a left hand is mirrored in
        vertices, joints = rig(shape, angles)
        torch.testing.assert_close(joints, ours)
        assert volume(vertices, rig.faces).min() > 0, side
        inside = torch.stack([winding(skin, rig.faces, points[1:])
                              for skin, points in zip(vertices, joints, strict=True)])
        assert (inside > 0.5).float().mean() > 0.97, side


def test_a_file_that_is_no_hand_is_refused(tmp_path, shared_data):
    for name, content in (('text.glb', b'no glTF at all'), ('empty.glb', b'')):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=name):
            Rig(tmp_path / name)
    with pytest.raises(InputError, match=r'nowhere\.glb: the file cannot be read \(No such file or directory\): check'):
        Rig(tmp_path / 'nowhere.glb')
    damaged = bytearray((shared_data / 'hand_models/webxr_generic_hand/right.glb').read_bytes())
    damaged = damaged.replace(b'"middle-finger-tip"', b'"middle-finger-tap"')
    (tmp_path / 'renamed.glb').write_bytes(damaged)
    with pytest.raises(InputError, match='middle-finger-tip'):
        Rig(tmp_path / 'renamed.glb')

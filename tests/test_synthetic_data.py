"""What the generator of synthetic hands promises to those who train on it."""

import math
import shutil
from dataclasses import replace
from itertools import product

import cv2
import numpy as np
import pytest
import torch

from hand_pose_ros.bags import DepthBag, read_hands
from hand_pose_ros.cli import main
from hand_pose_ros.detection import detect
from hand_pose_ros.geometry import Cube, Intrinsics
from hand_pose_ros.geometry import crop as crop_one
from hand_pose_ros.skeleton import HAND21
from hand_pose_ros.synthetic import benchmark, effects, scenes, sensors
from hand_pose_ros.synthetic.crops import crop, settle
from hand_pose_ros.synthetic.effects import Shot
from hand_pose_ros.synthetic.generator import LEFT, SPLITS, SyntheticHands
from hand_pose_ros.synthetic.hand import HandModel
from hand_pose_ros.synthetic.renderer import View, box, ellipsoid, plane, round_cone
from hand_pose_ros.synthetic.rig import Rig
from hand_pose_ros.synthetic.rng import Random
from hand_pose_ros.synthetic.sensors import SENSORS
from hand_pose_ros.synthetic.stages import CUBE_SIDE, Ingredients, Stages

CHUNK = 24  # smaller than by default: quick


pytestmark = pytest.mark.usefixtures('one_thread')


@pytest.fixture(scope='module')
def hands() -> SyntheticHands:
    return SyntheticHands('train', chunk=CHUNK)


@pytest.fixture(scope='module')
def batch(hands):
    return hands.batch(torch.arange(2 * CHUNK))


def test_batch_has_what_training_needs(batch):
    n = 2 * CHUNK
    assert batch['patch'].shape == (n, 1, 128, 128) and batch['patch'].dtype == torch.float32
    assert batch['joints'].shape == batch['joints_m'].shape == (n, 21, 3)
    assert batch['cube_center'].shape == (n, 3) and batch['cube_side'].shape == (n,)
    assert batch['visible'].shape == (n, 21) and batch['visible'].dtype == torch.bool
    for name, values in batch.items():
        assert len(values) == n and torch.isfinite(values.float()).all(), name
    assert batch['patch'].abs().max() <= 1
    assert set(batch['side'].tolist()) == {1, 2}, 'both hands'
    assert len(set(batch['sensor'].tolist())) > 5, 'many sensors'
    assert not batch['visible'][~batch['hand_present']].any()


def test_a_sample_depends_on_its_split_and_index_only(hands, batch):
    order = torch.tensor([31, 7, 2, 40])
    again = hands.batch(order)
    alone = hands.batch(order[1:2])
    for name, values in batch.items():
        assert torch.equal(again[name], values[order]), name
        assert torch.equal(alone[name], values[7:8]), name


def test_splits_share_nothing(batch):
    seen = batch['joints_m'][:8]
    for split in SPLITS[1:]:
        other = SyntheticHands(split, chunk=8).batch(torch.arange(8))['joints_m']
        bones = [(j[:, 9] - j[:, 0]).norm(dim=-1) for j in (seen, other)]
        assert not (bones[0][:, None] - bones[1][None]).abs().lt(1e-6).any(), 'the same hand in two splits'
    base = SyntheticHands('train', seed_base=1, chunk=8).batch(torch.arange(8))['joints_m']
    assert not torch.isclose(base, seen).all(-1).any()


def test_joints_in_cube_units_are_the_joints_in_metres(batch):
    for i in batch['hand_present'].nonzero()[:, 0].tolist():
        cube = Cube(tuple(batch['cube_center'][i].tolist()), float(batch['cube_side'][i]))
        expected = cube.to_cube(batch['joints_m'][i].numpy())
        if batch['side'][i] == LEFT:
            expected[:, 0] *= -1
        np.testing.assert_allclose(batch['joints'][i].numpy(), expected, atol=2e-5)


def test_patches_show_right_hands_only(batch):
    """In cube units the thumb of an open right hand is where a right hand's must be: the sign of a triple product."""
    j = batch['joints'][batch['hand_present']].double()
    palm = torch.linalg.cross(j[:, 5] - j[:, 17], j[:, 9] - j[:, 0])  # from thumb side x to fingers: out of the palm
    bent = (j[:, [8, 12, 16, 20]].mean(1) - j[:, [5, 9, 13, 17]].mean(1) - 0.8 * (j[:, 9] - j[:, 0]))
    towards = (palm * bent).sum(1)
    assert (towards > 0).float().mean() > 0.85, 'fingers bend to the palm of a right hand'


def test_visible_joints_lie_just_behind_the_surface():
    clean = SyntheticHands('val', ingredients=Ingredients(noise=False), chunk=CHUNK).batch(torch.arange(CHUNK))
    z = clean['joints'][..., 2]
    column, row = (((clean['joints'][..., i] + 1) * 64 - 0.5).round().long() for i in (0, 1))
    inside = (column >= 0) & (column < 128) & (row >= 0) & (row < 128)
    shown = clean['visible'] & inside
    at = row.clamp(0, 127) * 128 + column.clamp(0, 127)
    surface = clean['patch'].flatten(1).gather(1, at)
    behind_mm = (z - surface) * clean['cube_side'][:, None] / 2 * 1e3
    cut = surface <= -1  # before the cube's front face the depth is not known
    deep = behind_mm[shown & ~cut]
    assert len(deep) > 150
    assert deep.quantile(0.02) > 0, 'a visible joint is not in front of the surface'
    assert deep.quantile(0.98) < 40 and deep.median() > 4
    hidden = behind_mm[clean['hand_present'][:, None] & ~clean['visible'] & inside & ~cut]
    assert len(hidden) == 0 or hidden.median() > deep.median()


def test_the_surface_is_where_the_joints_say_to_a_tenth_of_a_millimetre():
    """Hands of sticks, whose surface is known: 12 mm around the bones at the wrist, 8 mm around all others."""
    sticks = SyntheticHands('val', sensors=['kinect1'], ingredients=Ingredients(
        noise=False, scenes=False, surface=False, forearm=False))
    sides = set()
    for index in (0, 2, 4):
        depth, camera, joints, side = sticks.full_frame(index)
        row, column = depth.nonzero()
        seen = camera.back_project(np.stack([column, row], -1), depth[row, column])
        outside = []
        for parent, child in HAND21.bones:
            start, along = joints[parent].astype(float), (joints[child] - joints[parent]).astype(float)
            offset = seen - start
            part = np.clip(offset @ along / (along @ along), 0, 1)
            outside.append(np.linalg.norm(offset - part[:, None] * along, axis=1) - (0.012 if parent == 0 else 0.008))
        assert len(seen) > 1500
        np.testing.assert_allclose(np.min(outside, 0), 0, atol=1e-4)
        sides.add(side)
    assert sides == {'left', 'right'}


@pytest.mark.parametrize('sensor', ['pmd', 'd415'])
def test_a_patch_is_the_products_crop_of_the_whole_image(sensor):
    """Exactly, but that of an image finer than the patch other pixels are left out."""
    alone = SyntheticHands('val', sensors=[sensor], ingredients=Ingredients(noise=False, scenes=False), chunk=12)
    batch = alone.batch(torch.arange(12))
    cubes = zip(batch['cube_center'].tolist(), batch['cube_side'].tolist(), strict=True)
    for index, (center, side) in enumerate(cubes):
        depth, camera, *_ = alone.full_frame(index)
        expected = crop_one(depth, Cube(tuple(center), side), camera)
        if batch['side'][index] == LEFT:
            expected = expected[..., ::-1]
        fine = camera.fx * side / center[2] > 128
        off = np.abs(batch['patch'][index].numpy() - expected) > 0.03
        assert off.mean() <= (0.02 if fine else 0.001)


def test_batched_crop_equals_the_products_crop():
    rng = np.random.default_rng(3)
    depth = np.where(rng.random((4, 150, 140)) < 0.2, 0, rng.uniform(0.3, 0.8, (4, 150, 140))).astype(np.float32)
    centers = torch.tensor([[0.01, -0.02, 0.5], [0.2, 0.1, 0.45], [-0.05, 0.3, 0.61], [0.0, 0.0, 0.55]])
    sides = torch.tensor([0.3, 0.25, 0.36, 0.3])
    fx, fy, cx, cy = (torch.tensor(v) for v in ([241.4, 180.0, 200.3, 588.0], [241.4, 181.0, 200.3, 587.1],
                                                [70.2, 60.0, 71.5, 69.5], [75.5, 70.0, 60.25, 74.5]))
    patches = crop(torch.from_numpy(depth), centers, sides, View(fx, fy, cx, cy, 150, 140))
    for i in range(4):
        camera = Intrinsics(float(fx[i]), float(fy[i]), float(cx[i]), float(cy[i]), 140, 150)
        expected = crop_one(depth[i], Cube(tuple(centers[i].tolist()), float(sides[i])), camera)
        np.testing.assert_array_equal(patches[i].numpy(), expected)


def test_detector_rule_agrees_with_the_product(hands):
    """On whole noisy frames of one hand the product settles where the generator says it does."""
    one = SyntheticHands('val', sensors=['kinect2'], chunk=8, ingredients=Ingredients(scenes=False))
    off = []
    for index in range(8):
        depth, camera, joints, side = one.full_frame(index)
        found = detect(depth, camera)
        if side == 'none' or not found:
            continue
        v = View(*(torch.tensor([x]) for x in (camera.fx, camera.fy, camera.cx, camera.cy)), *depth.shape)
        image = torch.from_numpy(depth)[None, 2::4, 2::4]
        v = View(v.fx / 4, v.fy / 4, (v.cx - 2) / 4, (v.cy - 2) / 4, *image.shape[1:])
        ours = settle(image, v, 0.30, 24, otherwise=torch.tensor(joints.mean(0))[None])
        off.append(np.linalg.norm(ours[0].numpy() - found[0].center))
    assert len(off) >= 5
    assert np.median(off) < 0.01


def test_crops_are_centred_as_the_product_does_it(batch):
    distance = batch['joints'][batch['hand_present']].mean(1) * batch['cube_side'][batch['hand_present'], None] / 2
    norm = distance.norm(dim=-1)
    assert 0.005 < norm.median() < 0.05, 'centres are neither perfect nor astray'
    assert norm.max() < 0.2


@pytest.mark.parametrize('name', [s.name for s in SENSORS])
def test_sensors_read_a_wall_right_and_nothing_as_nothing(name):
    sensor = sensors.get_sensor(name)
    near, far = SENSORS[sensor].hand_distance
    z = (near + far) / 2
    clean = torch.zeros(4, 90, 100)
    clean[:, 20:, :] = 1 / z
    focal = sensors.sensor_table('fx', torch.device('cpu'))[[sensor] * 4]
    depth = sensors.sense(clean, torch.arange(4), torch.tensor([sensor] * 4), focal, torch.tensor([False, True] * 2))
    assert torch.isfinite(depth).all() and (depth >= 0).all()
    wall = depth[:, 24:]
    assert (wall > 0).float().mean() > 0.85
    assert not depth[:, :16].any()
    error = (wall[wall > 0] - z).abs()
    assert error.median() < 0.004 and error.quantile(0.9) < 0.02
    assert error.max() > 0, 'no sensor is perfect'


def _shot(batch: int, sensor: str, mirrored: bool = False, scale: float = 1.0) -> Shot:
    s = SENSORS[sensors.get_sensor(sensor)]
    as_tensor = lambda value: torch.full((batch, 1, 1), value)  # noqa: E731
    rng = Random(torch.arange(batch))
    return Shot(rng.fork(1), rng, as_tensor(s.intrinsics.fx * scale), as_tensor(scale), as_tensor(1.0),
                as_tensor(mirrored), as_tensor(s.baseline), as_tensor(s.noise), as_tensor(max(s.step, 1e-3)),
                as_tensor(s.smoothing), 60, 120)


def test_shadow_is_on_one_side_and_as_wide_as_the_disparity_step():
    clean = torch.full((1, 60, 120), 1 / 1.0)
    clean[:, :, 60:80] = 1 / 0.8
    expected = 588.03 * 0.075 * (1 / 0.8 - 1 / 1.0)
    for mirrored, side in ((False, slice(0, 60)), (True, slice(80, 120))):
        lost = effects.shadow(clean, _shot(1, 'primesense', mirrored)) == 0
        assert abs(int(lost[0, 30].sum()) - expected) <= 1.5
        assert lost[0, 30, side].sum() == lost[0, 30].sum()
        lost = effects.shadow(clean, _shot(1, 'primesense', mirrored, scale=0.5)) == 0
        assert abs(int(lost[0, 30].sum()) - expected / 2) <= 2, 'half the pixels'


def test_steps_are_frayed_lost_or_mixed_while_surfaces_stay():
    """Each effect alone, where the last column at 0.8 m meets the first at 0.5 m."""
    far, near = torch.tensor(1 / 0.8), torch.tensor(1 / 0.5)
    clean = torch.where(torch.arange(120) < 60, far, near).expand(20, 60, 120)

    def shown(effect, sensor, image=clean, scale=1.0):
        result = effect(image, _shot(20, sensor, scale=scale))
        touched = (result != image).float().mean((0, 1))
        return result, touched[59], touched[60], torch.cat([touched[:58], touched[62:]]).max()

    frayed, behind, before, elsewhere = shown(effects.jitter, 'primesense')
    assert set(frayed.unique().tolist()) == {far.item(), near.item()} and elsewhere == 0
    assert 0.05 < behind < 0.4 and 0.05 < before < 0.4
    assert shown(effects.jitter, 'primesense', scale=0.25)[1] < behind / 4, 'less of a pixel that is larger'
    lost, behind, before, elsewhere = shown(effects.matching_window, 'primesense')
    assert 0.6 < behind < 0.95 and 0 < before < 0.2 and elsewhere == 0 and not lost[lost != clean].any()
    assert torch.equal(shown(effects.grazing_holes, 'primesense')[0], clean), 'a step is no grazing surface'
    bulged, behind, before, elsewhere = shown(effects.fattening, 'd435')
    assert 0.3 < behind < 0.9 and before == elsewhere == 0 and (bulged[bulged != clean] == near).all()
    mixed, behind, before, elsewhere = shown(effects.flying_pixels, 'kinect2')
    flying = mixed[(mixed != clean) & (mixed != 0)]
    assert behind > 0.8 and before == elsewhere == 0 and 0 < len(flying) < 0.2 * 20 * 60
    assert (far <= flying).all() and (flying <= near).all() and ((far < flying) & (flying < near)).any()
    smeared, _, _, elsewhere = shown(effects.edge_smear, 'kinect2')
    grown = 1 / smeared[..., 59] - 0.5
    grown = grown[grown < 0.1]
    assert len(grown) > 0.6 * 20 * 60 and grown.min() > 0.0035 and grown.max() < 0.0405 and elsewhere == 0
    assert (1 / smeared[..., 60:] - 0.5).abs().max() < 0.01
    assert (shown(effects.edge_smear, 'kinect2', scale=0.25)[0][..., 59] > 1 / 0.6).float().mean() < 0.5
    rough = clean + 0.01 * Random(torch.arange(20)).normal(60, 120)
    smooth, behind, before, _ = shown(effects.smoothing, 'sr305', rough)
    assert behind == before == 0 and (smooth - clean)[..., :58].std() < 0.005


def test_noise_has_the_measured_size_and_does_not_shift_surfaces():
    # In a window where every other pixel is left out, those that remain are as they were.
    for scale, (normal, tangent) in product((1.0, 0.5), (([0, 0, 1], 0), ([2, 0, 1], 2), ([0, 2, 1], 2))):
        v = View(*(torch.tensor([t]) for t in (364.5 * scale, 364.5 * scale, 60.0, 30.0)), 60, 120)
        image = plane(torch.tensor([normal]).float(), torch.tensor([0.6]), v).expand(40, -1, -1)
        off = (1 / effects.tof_noise(image, _shot(40, 'kinect2', scale=scale)) - 1 / image)[:, 25:36, 55:66]
        sigma = (1.5 - 0.3 + 0.108 + 0.0465 * tangent ** 2) * 1.3e-3  # Fankhauser 2015 at 0.6 m, times the sensor's
        assert off.std() == pytest.approx(sigma, rel=0.1) and off.mean().abs() < sigma / 5
    image = torch.linspace(1 / 0.6, 1 / 0.65, 120).expand(20, 60, 120)
    for scale in (1.0, 0.5):
        off = (effects.disparity_noise(image, _shot(20, 'primesense', scale=scale)) - image) * 588.03 * 0.075
        assert off.std() == pytest.approx(math.hypot(0.045, 1 / 8 / math.sqrt(12)), rel=0.1)
        assert off.mean().abs() < 0.005
    assert not effects.disparity_noise(torch.zeros(1, 60, 120), _shot(1, 'primesense')).any()


def test_light_that_bounces_in_a_hollow_makes_it_deeper():
    row, column = torch.meshgrid(torch.arange(60), torch.arange(120), indexing='ij')
    depth = (0.5 + 0.02 * torch.exp(-((row - 30) ** 2 + (column - 60) ** 2) / 36)).expand(20, -1, -1)
    deeper = 1 / effects.multipath(1 / depth, _shot(20, 'kinect2')) - depth
    assert 5e-4 < deeper[:, 28:33, 58:63].mean() < 0.01
    assert deeper.min() > -1e-6 and deeper[:, :, :20].abs().max() < 1e-6


def test_dark_spots_last_and_specks_do_not():
    clean = torch.ones(40, 60, 120)
    first, again = (effects.dark_spots(clean, replace(_shot(40, 'kinect2'), rng=Random(torch.arange(40)).fork(frame)))
                    for frame in (1, 2))
    lost = torch.stack([first, again]) == 0
    assert ((first == 0) | (first == 1)).all() and 2e-4 < lost.float().mean() < 0.02
    wide = torch.nn.functional.avg_pool2d(lost.float(), 3, 1, 1) > 0.99  # in patches
    assert wide.any() and torch.equal(wide[0], wide[1])
    assert (lost[0] != lost[1]).sum() > 50


def test_disparity_comes_in_steps_that_grow_with_distance():
    for z in (0.6, 1.2):
        ramp = torch.linspace(1 / z, 1 / (z + 0.05), 120).expand(1, 60, 120)
        depth = 1 / effects.disparity_noise(ramp, _shot(1, 'primesense'))
        steps = depth.unique().diff()
        assert steps[steps > 1e-5].median() == pytest.approx(z * z / (588.03 * 0.075) / 8, rel=0.15)


def test_grazing_surfaces_are_lost_and_frontal_ones_are_not():
    v = View(*(torch.tensor([t]) for t in (588.0, 588.0, 60.0, 30.0)), 60, 120)
    for tangent, low, high in ((0.3, 0.95, 1.0), (3.0, 0.6, 0.95), (5.5, 0.05, 0.4), (12.0, 0.0, 0.05)):
        for normal in ([tangent, 0.0, 1.0], [0.0, tangent, 1.0]):
            image = plane(torch.tensor([normal]), torch.tensor([0.6]), v).expand(20, -1, -1)
            kept = (effects.grazing_holes(image, _shot(20, 'primesense')) > 0).float().mean()
            assert low <= kept <= high


@pytest.mark.parametrize('without', ['surface', 'poses', 'forearm', 'scenes', 'noise', 'detector'])
def test_each_ingredient_can_be_left_out(without, batch):
    plain = SyntheticHands('train', ingredients=Ingredients(**{without: False})).batch(torch.arange(8))
    assert torch.isfinite(plain['patch']).all()
    changed = 'joints_m' if without == 'poses' else 'patch'
    assert not torch.equal(plain[changed], batch[changed][:8])
    if without != 'poses':
        assert torch.equal(plain['joints_m'], batch['joints_m'][:8]), 'the same hands'
    if without == 'detector':
        torch.testing.assert_close(plain['joints_m'].mean(1)[plain['hand_present']],
                                   plain['cube_center'][plain['hand_present']])


# What else is there --------------------------------------------------------------------------------------------------

@pytest.fixture(scope='module')
def stage():
    """400 scenes, as they stand before they are drawn."""
    return Stages(Ingredients(), torch.arange(len(SENSORS)), HandModel(), torch.device('cpu')).build(torch.arange(400))


def window(stage) -> View:
    """48 x 48 pixels around each hand."""
    view, _ = stage.window(stage.scene.joints.mean(1), torch.full((400,), CUBE_SIDE))
    return View(view.fx / 3, view.fy / 3, (view.cx - 1) / 3, (view.cy - 1) / 3, 48, 48)


def test_what_else_is_there_only_hides():
    bare, full = (SyntheticHands('train', chunk=CHUNK, ingredients=Ingredients(
        noise=False, detector=False, scenes=scenes)).batch(torch.arange(2 * CHUNK)) for scenes in (False, True))
    assert torch.equal(bare['joints'], full['joints'])
    assert (full['patch'] <= bare['patch'] + 1e-6).all()
    assert not (full['visible'] & ~bare['visible']).any()
    hidden = (bare['visible'] & ~full['visible']).sum() / bare['visible'].sum()
    assert 0.002 < hidden < 0.1, 'most joints are not hidden by what else is there'


def test_tables_walls_and_bodies_are_behind_hand_and_arm(stage):
    scene = stage.scene
    (plane_there,) = (solid for solid in scene.soft if solid.draw is plane)
    normal, distance = plane_there.measures
    beyond = (scene.vertices[plane_there.samples] @ normal[..., None])[..., 0].amax(1) - distance
    assert beyond.max() < 1e-5 and 0.15 < (beyond > -1e-4).float().mean() < 0.5, 'some touch, none cuts'
    tables = normal[:, 1] > 0.5
    assert 0.1 < tables.float().mean() < 0.4 and not (normal[:, 1] < -0.8).any(), 'a table is below'
    seated = [solid for solid in scene.soft if solid.draw is ellipsoid and scene.present[solid.samples].any()]
    torso, head = seated
    for solid in seated:
        center, _, radii = solid.measures
        assert (center[:, 2] - radii.amax(1) > scene.joints[solid.samples][..., 2].amax(1) - 0.25).all()
    nearest = torso.measures[0][:, 2] - torso.measures[2][:, 2]
    assert (nearest > scene.joints[torso.samples][..., 2].amax(1)).all()
    assert (head.measures[0][:, 1] < torso.measures[0][:, 1] - 0.25).all(), 'heads up'


def test_things_are_held_on_the_side_of_the_palm_and_lie_mostly_behind(stage):
    scene = stage.scene
    joints, held, before, behind = scene.joints, 0, 0, 0
    palmar = torch.linalg.cross(joints[:, 5] - joints[:, 17], joints[:, 9] - joints[:, 0])
    palm = joints[:, (0, 5, 9, 13, 17)].mean(1)
    for number, solid in enumerate(scene.hard):
        at, here = solid.balls.mean(1), solid.samples
        if number < 3:
            held += len(here)
            assert (((at - palm[here]) * palmar[here]).sum(1) > 0).all()
            assert ((at - palm[here]).norm(dim=1) < 0.12).all()
        elif scene.present[here].any() and solid.draw in (ellipsoid, box):
            center, _, size = solid.measures
            near, far = joints[here][..., 2].aminmax(dim=1)
            first = center[:, 2] + size.amax(1) < near
            assert (first | (center[:, 2] - size.amax(1) > far)).all(), 'none runs through the hand'
            assert (center[:, 2] - size.amax(1) > 0.1).all(), 'nor into the camera'
            before, behind = before + int(first.sum()), behind + int((~first).sum())
    assert 0.08 * 400 < held < 0.2 * 400
    assert 5 < before < 0.3 * behind


def test_sleeves_leave_the_hand_bare(stage):
    scene = stage.scene
    view = window(stage)
    hand = scenes.splat(scene.joints[:, 3:], view) > 0
    clothes = [solid for solid in scene.soft if solid.draw is round_cone and scene.present[solid.samples].any()]
    covered = scenes.draw_solids(replace(scene, soft=clothes, hard=[], others=None), view) > 0
    assert (covered & hand).sum() < 0.1 * hand.sum()
    wrist = scenes.splat(scene.joints[:, :1], view) > 0
    assert 0.05 < (covered & wrist).sum() / wrist.sum() < 0.5


def test_most_images_without_a_hand_show_something_in_its_place(stage):
    scene = stage.scene
    absent = (~scene.present).nonzero()[:, 0]
    assert 0.02 < len(absent) / 400 < 0.09
    put = torch.cat([solid.samples for solid in scene.soft + scene.hard if not scene.present[solid.samples].any()])
    assert 0.6 < len(put) / len(absent) <= 1 and set(put.tolist()) <= set(absent.tolist())


def test_what_is_left_out_of_a_window_cannot_be_seen_in_it(stage):
    scene = stage.scene
    view = window(stage)
    back = scene.joints.mean(1)[:, 2] + CUBE_SIDE / 2
    whole, cut = scenes.draw_solids(scene, view), scenes.draw_solids(scene, view, back)
    seen = whole > 1 / back[:, None, None]
    assert torch.equal(whole[seen], cut[seen]) and (cut != whole).any()


def test_second_hands_are_beside_the_first_and_mostly_left(stage):
    others = stage.scene.others
    assert 0.04 < len(others.samples) / 400 < 0.13 and 0.5 < others.left.float().mean() < 0.9
    a, b, c = (others.vertices[:, corner].double() for corner in HandModel().faces.T)
    volume = (a * torch.linalg.cross(b, c)).sum((1, 2))
    assert torch.equal(volume < 0, others.left), 'the skin of a left hand is mirrored'
    hand = others.vertices[:, HandModel().vertex_part != 6].mean(1)
    apart = (hand - stage.scene.joints[others.samples].mean(1)).norm(dim=1)
    assert apart.min() > 0.06 and apart.max() < 0.4
    view, alone = window(stage), HandModel()
    image, own = Stages(Ingredients(), torch.arange(len(SENSORS)), alone, torch.device('cpu')).draw(stage, view)
    first, second = scenes.draw_hands(stage.scene, alone.faces, view)
    assert torch.equal(own, first), 'joints are not visible for the skin of another hand'
    assert second.any() and (image >= second).all()


def test_full_frame_and_moving_hand():
    one = SyntheticHands('val', sensors=['sr305'], chunk=8)
    frames = list(one.sequence(3, 4))
    sides = {side for *_, side in frames}
    assert len(sides) == 1 and sides <= {'left', 'right'}
    for depth, camera, joints, _ in frames:
        camera.check_size(*depth.shape[::-1])
        assert depth.dtype == np.float32 and np.isfinite(depth).all() and (depth > 0).any()
        u, v = camera.project(joints).round().astype(int).T
        seen = depth[np.clip(v, 0, 479), np.clip(u, 0, 639)]
        assert np.median(np.abs(seen[seen > 0] - joints[seen > 0, 2])) < 0.06, 'the hand is where its joints are'
    moved = np.linalg.norm(frames[1][2] - frames[0][2], axis=-1)
    assert moved.max() < 0.03, 'smoothly'
    assert not np.array_equal(frames[0][0], frames[1][0])
    again = list(one.sequence(3, 4))
    assert np.array_equal(again[2][0], frames[2][0])


def test_full_frames_show_the_samples_of_the_batch(hands, batch):
    for side, name in enumerate(('left', 'right'), start=LEFT):
        index = int(((batch['side'] == side) & batch['hand_present']).nonzero()[0])
        *_, joints, shown = hands.full_frame(index)
        assert shown == name
        np.testing.assert_allclose(joints, batch['joints_m'][index].numpy(), atol=1e-6)


def test_a_hand_moves_softly_between_poses_in_a_scene_that_stands_still():
    noisy, clean = (SyntheticHands('train', sensors=['pmd'], ingredients=Ingredients(noise=noise))
                    for noise in (True, False))
    *_, joints, side = clean.full_frame(61)
    assert side == 'none' and not joints.any(), 'a sample without a hand'
    depths, _, joints, sides = zip(*clean.sequence(61, 9, frames_per_key=4), strict=True)
    assert set(sides) <= {'left', 'right'}, 'has one in motion'
    at = np.mean(joints, axis=1)
    for key in (0, 4):
        begun = (at[key + 1] - at[key]) / (at[key + 2] - at[key])
        np.testing.assert_allclose(begun, 1 - math.cos(math.pi / 4), atol=1e-3)
    assert np.linalg.norm(at[8] - at[0]) > 0.005, 'and goes on to a third place'
    still = depths[0] == depths[8]
    assert still.mean() > 0.75
    first, second = (depth for depth, *_ in noisy.sequence(61, 2, frames_per_key=4))
    assert (first != second)[still].mean() > 0.1, 'the noise does not stand still'


def test_whole_scenes_say_where_both_hands_are():
    kinect = SyntheticHands('train', sensors=['kinect2'], ingredients=Ingredients(noise=False), chunk=CHUNK)
    scenes = kinect.scenes(torch.arange(2 * CHUNK), 364.5 / 4, 160, 120)  # 128 x 106 pixels of the sensor in each
    depth, hands, shown = (scenes[name].numpy() for name in ('depth', 'hands', 'shown'))
    assert shown[:, 0].sum() > 40 and 2 < shown[:, 1].sum() < 8 and not hands[~shown].any()
    for number in 0, 1:
        rows = shown[:, number].nonzero()[0]
        u, v = hands[rows, number, :2].round().astype(int).T
        assert np.median(np.abs(depth[rows, v, u] - hands[rows, number, 2])) < 0.05
    columns, rows = (np.where(depth.any(axis), 1, 0) for axis in (1, 2))
    for lit, size in ((columns, 128), (rows, 106)):
        extent = lit.shape[1] - lit[:, ::-1].argmax(1) - lit.argmax(1)
        assert extent.max() == size, 'nothing is beside the image of the sensor'
    moved = []
    for index in range(6):
        _, camera, joints, side = kinect.full_frame(index)
        u, v = camera.project(joints.mean(0))
        u = camera.width - 1 - u if side == 'left' else u  # scenes are those of right hands
        moved.append(hands[index, 0, :2] - ((np.array([u, v]) + 0.5) / 4 - 0.5))
        assert hands[index, 0, 2] == pytest.approx(joints.mean(0)[2], abs=1e-5)
    np.testing.assert_allclose(moved, np.round(moved), atol=1e-2)
    assert np.min(moved) > -0.1 and (np.max(moved, axis=0) < [32.1, 14.1]).all()
    assert (np.ptp(moved, axis=0) > 3).all(), 'the window is anywhere'


def test_another_skin_has_the_joints_of_its_rig(shared_data):
    rig = Rig(shared_data / 'hand_models' / 'webxr_generic_hand' / 'right.glb')
    rigged, ours = (SyntheticHands('val', hand=hand, ingredients=Ingredients(
        noise=False, scenes=False, detector=False)).batch(torch.arange(8)) for hand in (rig, None))
    assert rigged['visible'].float().mean() > 0.4
    assert torch.equal(rigged['hand_present'], ours['hand_present'])
    both = (rigged['patch'] < 1) & (ours['patch'] < 1)
    either = (rigged['patch'] < 1) | (ours['patch'] < 1)
    assert both.sum() > 0.9 * either.sum(), 'as large, in the same place, with the same arm'
    assert (rigged['patch'] - ours['patch'])[both].abs().quantile(0.9) < 0.06
    assert not torch.equal(rigged['patch'], ours['patch'])


def test_command_line_shows_writes_and_measures(tmp_path, capsys, shared_data):
    real = ['--real', str(shared_data / 'frames' / 'sr305'), '476.0', '476.0', '313.7', '242.8', '0.000125']
    sheet = tmp_path / 'sheet.png'
    assert main(['synth', 'show', str(sheet), '--number', '4', '--joints', '--per-sensor', '--sensors', 'd435', 'sr305',
                 *real]) == 0
    picture = cv2.imread(str(sheet))
    assert picture is not None and picture.std() > 20
    assert main(['synth', 'show', str(tmp_path / 'new' / 'sheet.png'), '--number', '1']) == 0
    assert (tmp_path / 'new' / 'sheet.png').exists() and capsys.readouterr().out.endswith(': 1 picture\n')
    two, second, clean, joints = (tmp_path / f'{name}.png' for name in ('two', 'second', 'clean', 'joints'))
    for file, *options in ((two, '--number', '2'), (second, '--start', '1', '--number', '1'),
                           (clean, '--number', '2', '--clean'), (joints, '--number', '2', '--joints')):
        assert main(['synth', 'show', str(file), '--split', 'val', '--sensors', 'd435', *options]) == 0
    noisy, one, perfect, drawn = (cv2.imread(str(file)).astype(int) for file in (two, second, clean, joints))
    np.testing.assert_array_equal(one, noisy[:, 256:])
    rough, smooth = (np.abs(np.diff(picture[20:], axis=0)).mean() for picture in (noisy, perfect))
    assert smooth < 0.7 * rough
    assert (np.ptp(drawn, axis=2) > 0).any() and not np.ptp(noisy, axis=2).any()  # joints are all that is coloured

    assert main(['synth', 'record', str(tmp_path / 'raw.mcap'), '--number', '2', '--raw']) == 0
    with DepthBag(tmp_path / 'raw.mcap') as bag:
        assert bag.depth_topic == '/depth/image_rect' and len(bag) == 2
        truth = read_hands(tmp_path / 'raw.mcap', '/truth/joints')
        for i, (image, hand, (depth, camera, joints, side)) in enumerate(zip(
                bag, truth, SyntheticHands('train').sequence(0, 2), strict=True), start=1):
            assert image.stamp_ns == hand.stamp_ns == i * 10 ** 9 // 30 and image.frame_id == hand.frame_id
            assert image.intrinsics == camera and hand.sides == (side,)
            np.testing.assert_allclose(image.depth, depth, atol=0.00051)
            np.testing.assert_allclose(hand.joints[0], joints, atol=1e-6)
    assert main(['synth', 'write', str(tmp_path / 'data'), '--number', '5', '--shard', '3', '--split', 'val', '--start',
                 '1']) == 0
    shards = sorted((tmp_path / 'data').iterdir())
    assert [shard.name for shard in shards] == ['val_000000001.npz', 'val_000000004.npz']
    with np.load(shards[1]) as shard:
        expected = SyntheticHands('val').batch(torch.tensor([4, 5]))
        assert shard['index'].tolist() == [4, 5]
        np.testing.assert_array_equal(shard['joints'], expected['joints'].numpy())
        np.testing.assert_allclose(shard['patch'], expected['patch'].numpy(), atol=5e-4)

    capsys.readouterr()
    assert main(['synth', 'stats', '--number', '8', *real]) == 0
    table = capsys.readouterr().out
    assert 'real sr305' in table and 'missing' in table
    long = tmp_path / 'recorded in a house with a garden'
    long.symlink_to(real[1])
    assert main(['synth', 'stats', '--number', '8', '--real', str(long), *real[2:]]) == 0
    head, *rows = capsys.readouterr().out.splitlines()
    assert f'(quartiles)  real {long.name}  ' in head
    assert all(row.count(')  ') == 1 for row in rows), 'columns stand apart'

    assert main(['synth', 'stats', *real[:2], *['many'] * 5]) == 1
    assert 'many: after the folder come five numbers, FX FY CX CY SCALE' in capsys.readouterr().err
    assert main(['synth', 'show', str(sheet), '--sensors', 'kinect9']) == 1
    assert "unknown sensor 'kinect9'" in capsys.readouterr().err
    assert main(['synth', 'show', str(tmp_path / 'sheet.jpeg2')]) == 1
    assert 'give a name that ends in .png' in capsys.readouterr().err


def test_real_hands_have_a_row_of_their_own_above_the_synthetic(tmp_path, shared_data):
    for number in '30', '170':  # fewer than there are columns
        shutil.copy(next((shared_data / 'frames' / 'sr305').rglob(f'{number}.png')), tmp_path)
    sheet = tmp_path / 'sheets' / 'sheet.png'
    assert main(['synth', 'show', str(sheet), '--number', '3', '--per-sensor', '--sensors', 'd435', 'sr305',
                 '--real', str(tmp_path), '476.0', '476.0', '313.7', '242.8', '0.000125']) == 0
    rows = np.array(np.split(cv2.imread(str(sheet)), 3)).reshape(3, 256, 3, 256, 3).swapaxes(1, 2)
    first, second, nothing = rows[0]
    assert (first != second).mean() > 0.05 and not nothing.any()
    assert all(picture.std() > 20 for picture in rows[1:].reshape(6, 256, 256, 3))


def test_benchmark_is_the_frozen_one():
    batch = next(benchmark.frames(benchmark.PREFIX, batch=benchmark.PREFIX))
    np.testing.assert_allclose(benchmark.digest(batch), benchmark.PREFIX_DIGEST, atol=2e-3)
    if benchmark.made_with() != benchmark.PREFIX_MADE_WITH:
        pytest.skip(f'frozen with {benchmark.PREFIX_MADE_WITH}; {benchmark.made_with()} may round differently')
    assert benchmark.checksum(batch) == benchmark.PREFIX_SHA256

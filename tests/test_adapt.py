"""`hand-pose adapt`: labels better than one look, weights that load, and a comparison that does not flatter."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hand_pose_ros.bags import BagWriter
from hand_pose_ros.cli import adapt as verb
from hand_pose_ros.cli import main
from hand_pose_ros.estimator import HandEstimate, HandPoseEstimator
from hand_pose_ros.evaluation.metrics import bone_drift_mm
from hand_pose_ros.evaluation.results import Result
from hand_pose_ros.geometry import Cube, Intrinsics
from hand_pose_ros.models import build
from hand_pose_ros.models.checkpoints import WEIGHTS, load_checkpoint, save_checkpoint
from hand_pose_ros.skeleton import HAND21
from hand_pose_ros.synthetic.generator import SyntheticHands
from hand_pose_ros.synthetic.hand import HandModel
from hand_pose_ros.synthetic.kinematics import INDEX
from hand_pose_ros.synthetic.rng import Random
from hand_pose_ros.synthetic.shapes import sample_shapes
from hand_pose_ros.synthetic.stages import Ingredients
from hand_pose_ros.training import adapt, fitting
from hand_pose_ros.training.adapt import Look, _Crops, consensus, fine_tune, is_better, judge
from hand_pose_ros.training.fitting import fit_hand

pytestmark = pytest.mark.usefixtures('one_thread')
IMAGES = 84


def at_once(items, total):
    return items


@pytest.fixture(scope='module')
def bag(tmp_path_factory) -> Path:
    """A few images of a hand before a perfect sensor, there and back again and again, with the truth."""
    hands = SyntheticHands('test', sensors=['senz3d'], ingredients=Ingredients(noise=False, scenes=False))
    film = list(hands.sequence(0, 6))
    path = tmp_path_factory.mktemp('bags') / 'hand.mcap'
    with BagWriter(path) as writer:
        for i in range(IMAGES):
            depth, camera, joints, side = film[5 - abs(i % 10 - 5)]
            stamp, cube = 10**9 + i * 33_333_333, Cube(tuple(joints.mean(0).tolist()), 0.3)
            truth = HandEstimate(joints, HAND21.joint_names, np.ones(21, np.float32), 1.0, side, cube, 'truth')
            writer.write_depth(stamp, 'camera', depth, camera)
            writer.write_hands(stamp, 'camera', [truth], topic='/truth/joints')
    return path


@pytest.fixture
def little(monkeypatch) -> None:
    """Enough to go through everything, too little to become better."""
    monkeypatch.setattr(adapt, 'VIEWS', 2)
    monkeypatch.setattr(fitting, 'STEPS', 5)
    monkeypatch.setattr(verb, 'CHECKED', 8)


def test_weights_come_out_with_a_comparison(bag, little, tmp_path, capsys):
    shipped = {path: path.read_bytes() for path in WEIGHTS.rglob('*.safetensors')}
    out = tmp_path / 'new' / 'mine.safetensors'
    assert main(['adapt', str(bag), '--steps', '2', '--ground-truth', '/truth/joints', '--out', str(out)]) == 0
    said = capsys.readouterr().out
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    assert {path: path.read_bytes() for path in WEIGHTS.rglob('*.safetensors')} == shipped

    before, after = load_checkpoint(), load_checkpoint(out)
    assert any(not torch.equal(a, b) for a, b in zip(before.network.parameters(), after.network.parameters(),
                                                     strict=True))
    facts = after.metadata['adapted']
    assert facts['from'] == 'hand_dense' and facts['bag'] == 'hand.mcap' and facts['steps'] == 2
    assert 20 <= facts['images'] <= IMAGES * 0.75
    assert 'validation' not in after.metadata and 'hand.mcap' in after.metadata['data']
    json.dumps(facts, allow_nan=False)
    for name in ('before', 'after'):
        assert 0 < facts[name]['error_mm'] < 60 and facts[name]['found'] == 1
        assert f"{facts[name]['error_mm']:.1f}" in said
    assert 'synthetic-test-v1, first 8 frames' in said and f'--model {out}' in said
    assert ('keep hand_dense' in said) == (facts['after']['error_mm'] >= facts['before']['error_mm'])
    assert HandPoseEstimator.from_pretrained(out, device='cpu').metadata['name'] == 'mine'


def test_images_of_one_stamp_cannot_be_parted(tmp_path, capsys):
    with BagWriter(tmp_path / 'still.mcap') as writer:
        for _ in range(3):
            writer.write_depth(5, 'camera', np.full((120, 160), 3, np.float32), Intrinsics(150, 150, 80, 60, 160, 120))
    assert main(['adapt', str(tmp_path / 'still.mcap'), '--out', str(tmp_path / 'x.safetensors')]) == 1
    assert 'still.mcap: all images have the stamp 5 ns' in capsys.readouterr().err


def test_what_got_worse_is_said(bag, little, tmp_path, capsys, monkeypatch):
    """Weights that were ruined by training: they find no hand any more, and know nothing of the benchmark."""
    monkeypatch.setattr(adapt, 'fine_tune', lambda *_: build('hand_dense', joints=21))
    out = tmp_path / 'ruined.safetensors'
    assert main(['adapt', str(bag), '--steps', '1', '--ground-truth', '/truth/joints', '--out', str(out)]) == 0
    said = capsys.readouterr().out
    assert 'WARNING: on synthetic-test-v1 the adapted weights are worse' in said
    assert 'no better on the held-out images: keep hand_dense' in said


def test_bags_that_cannot_be_learned_from_are_refused_in_one_sentence(tmp_path, capsys):
    wall, broken, out = tmp_path / 'wall.mcap', tmp_path / 'broken.mcap', tmp_path / 'out.safetensors'
    with BagWriter(wall) as writer:
        for stamp in range(4):
            writer.write_depth(stamp, 'camera', np.full((120, 160), 3, np.float32),
                               Intrinsics(140, 140, 80, 60, 160, 120))
    broken.write_bytes(b'no bag at all')
    for path, reason in ((wall, 'a hand was found in 0 of'), (broken, 'cannot be opened'),
                         (tmp_path / 'missing.mcap', 'no such bag')):
        assert main(['adapt', str(path), '--out', str(out)]) == 1
        said = capsys.readouterr().err
        error = [line for line in said.splitlines() if line.startswith('hand-pose adapt: ')]
        assert len(error) == 1 and path.name in error[0] and reason in error[0]
        assert 'comparison' not in said, 'it is said before further work'
    assert not out.exists()


def test_weights_that_cannot_be_adapted_are_refused(bag, tmp_path, capsys):
    model = tmp_path / 'nyu.safetensors'
    save_checkpoint(model, build('deep_prior', joints=14), {'skeleton': 'nyu14', 'cube_side': 0.3})
    out = tmp_path / 'out.safetensors'
    assert main(['adapt', str(bag), '--model', str(model), '--out', str(out)]) == 1
    assert 'nyu14' in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(['adapt', str(bag), '--out', str(tmp_path / 'out.onnx')])
    (tmp_path / 'file').write_text('')
    assert main(['adapt', str(bag), '--out', str(tmp_path / 'file' / 'out.safetensors')]) == 1
    assert 'choose another place' in capsys.readouterr().err


# Labels

def plates() -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Patches with three plates at depths of their own, and where these are, in cube units."""
    random = torch.Generator().manual_seed(1)
    centers = torch.rand(5, 3, 2, generator=random) * 0.3 - 0.15 + torch.tensor([[-0.3, -0.2], [0.3, 0], [-0.1, 0.4]])
    depths = torch.tensor([-0.3, 0.05, 0.4]).expand(5, 3)
    line = (torch.arange(128) + 0.5) / 64 - 1
    patches = torch.ones(5, 1, 128, 128)
    for patch, at, z in zip(patches, centers, depths, strict=True):
        for (x, y), depth in zip(at, z, strict=True):
            patch[0][((line[None] - x) ** 2 + (line[:, None] - y) ** 2) < 0.15 ** 2] = depth
    cubes = {'cube_center': torch.tensor([[0.1, -0.05, 0.6]]).expand(5, 3), 'cube_side': torch.full((5,), 0.3)}
    return {'patch': patches, **cubes}, torch.cat([centers, depths[..., None]], dim=-1)


def find_plates(patches: np.ndarray) -> np.ndarray:
    """A network that makes no mistakes: it sees the plates wherever they are."""
    found = []
    for patch in patches[:, 0]:
        for z in np.unique(patch[patch < 1]):
            rows, columns = np.nonzero(patch == z)
            found.append(((columns.mean() + 0.5) / 64 - 1, (rows.mean() + 0.5) / 64 - 1, z))
    return np.array(found, np.float32).reshape(len(patches), -1, 3)


def test_answers_to_augmented_crops_are_mapped_back_to_the_crop():
    crops, truth = plates()
    joints, spread = consensus(find_plates, crops, at_once)
    assert (joints - truth).abs().max() < 1 / 64  # a pixel
    assert spread.max() < 0.003


def test_answers_that_do_not_follow_the_crop_disagree():
    crops, _ = plates()
    _, spread = consensus(lambda patches: np.tile(np.float32([[0.5, 0, 0]]), (len(patches), 3, 1)), crops, at_once)
    assert spread.min() > 0.03


@pytest.fixture(scope='module')
def moving_hand() -> tuple[torch.Tensor, torch.Tensor]:
    """Joints (12, 21, 3) and some of the skin (12, 60, 3) of a hand of its own measures that opens, in metres."""
    count = 12
    shape = sample_shapes(Random(torch.tensor([5])))
    pose = fitting.LIMITS.mean(1).repeat(count, 1) * 0.5
    pose[:, INDEX['index_pip_flexion']] = torch.linspace(1.2, 0.1, count)
    pose[:, INDEX['middle_mcp_flexion']] = torch.linspace(0.9, 0.0, count)
    model = HandModel()
    shapes = type(shape)(*(getattr(shape, name).repeat(count, *[1] * (getattr(shape, name).ndim - 1))
                           for name in shape.__dataclass_fields__))
    skin, joints = model(shapes, pose)
    chosen = (model.vertex_part != 6).nonzero()[:, 0]
    chosen = chosen[torch.randperm(len(chosen), generator=torch.Generator().manual_seed(0))[:60]]
    turn = torch.tensor([[0.0, -1, 0], [0.8, 0, 0.6], [-0.6, 0, 0.8]])  # fingers to the left, palm askew
    move = torch.stack([torch.linspace(0, 0.1, count), torch.zeros(count), torch.full((count,), 0.5)], -1)[:, None]
    return joints @ turn.T + move, skin[:, chosen] @ turn.T + move


def test_one_hand_through_noisy_estimates_is_nearer_to_the_truth(moving_hand):
    truth, skin = moving_hand
    noisy = truth + 0.007 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(3))
    fitted = fit_hand(noisy, torch.ones(len(truth), 21), torch.arange(len(truth)), skin)
    assert (fitted - truth).norm(dim=-1).mean() < 0.6 * (noisy - truth).norm(dim=-1).mean()
    assert bone_drift_mm(fitted, HAND21).max() < 0.1 < bone_drift_mm(noisy, HAND21).min()


def test_depth_pulls_the_hand_to_where_it_was_measured(moving_hand):
    truth, skin = moving_hand
    aside = truth + torch.tensor([0, 0, 0.008])
    ones, rows = torch.ones(len(truth), 21), torch.arange(len(truth))
    fitted, blind = (fit_hand(aside, ones, rows, points) for points in (skin, torch.full_like(skin, 9.0)))
    assert (fitted - truth).norm(dim=-1).mean() < 0.9 * (blind - truth).norm(dim=-1).mean()


# Training and judgement

def test_what_is_judged_on_is_held_out_and_a_while_after_what_is_learned_from():
    stamps, truth = np.arange(100) * 10**9, np.zeros((100, 21, 3))
    wrong = truth + np.where(np.arange(100) < 75, 0.5, 0.01)[:, None, None] * [1, 0, 0]
    crops = {'patch': torch.zeros(0, 1, 128, 128), 'joints': torch.zeros(0, 21, 3), 'cube_side': torch.zeros(0)}
    result = Result('bag', HAND21, Intrinsics(140, 140, 80, 60, 160, 120), wrong, truth, stamps)
    found = Look(result, torch.zeros(0, dtype=torch.int64), crops)
    assert [np.flatnonzero(part).tolist() for part in found.split()] == [list(range(74)), list(range(75, 100))]
    assert judge(found, None, at_once)['error_mm'] == pytest.approx(10)


def test_hands_of_the_other_side_are_left_out_and_left_ones_are_mirrored():
    camera, seen = Intrinsics(140, 140, 80, 60, 160, 120), _Crops()
    joints, cube = np.full((21, 3), (0.1, 0.02, 0.5), np.float32), Cube((0.1, 0.02, 0.5), 0.3)
    for side in ('left', 'right', 'none', 'left'):
        hand = HandEstimate(joints + np.float32([0.03, 0, 0]), HAND21.joint_names, np.ones(21, np.float32), 1.0, side,
                            cube, 'a')
        image = SimpleNamespace(depth=np.full((120, 160), 0.5, np.float32), intrinsics=camera)
        seen.add(image, [] if side == 'none' else [hand, hand])
    rows, crops = seen.batch()
    assert rows.tolist() == [0, 3]
    np.testing.assert_allclose(crops['joints'][:, :, 0], -0.2, atol=1e-6)
    np.testing.assert_allclose(crops['cube_center'], [(-0.1, 0.02, 0.5)] * 2, atol=1e-6)


def test_images_that_are_no_label_are_left_out(monkeypatch):
    count = 30
    spread, joints = torch.full((count, 21), 0.004), torch.zeros(count, 21, 3)
    spread[3], joints[20] = 0.02, 0.5  # of no agreement, and 75 mm beside where the hand is before and after
    crops = {'patch': torch.zeros(count, 1, 128, 128), 'cube_center': torch.tensor([[0, 0, 0.5]]).expand(count, 3),
             'cube_side': torch.full((count,), 0.3), 'number': torch.arange(count)}
    monkeypatch.setattr(adapt, 'consensus', lambda *_: (joints, spread))
    monkeypatch.setattr(adapt, 'fit_hand', lambda points, *_: points)
    labelled = adapt.label(SimpleNamespace(run=None), torch.arange(count), crops, at_once)
    assert labelled['number'].tolist() == [row for row in range(count) if row not in (3, 20)]


def test_fine_tuning_learns_the_labels_and_leaves_the_original_alone(monkeypatch):
    monkeypatch.setattr(adapt, 'RATE', 1e-2)
    random = torch.Generator().manual_seed(0)
    samples = {'patch': torch.rand(8, 1, 128, 128, generator=random) * 0.5, 'joints': torch.full((8, 21, 3), 0.3),
               'cube_center': torch.tensor([[0, 0, 0.6]]).expand(8, 3), 'cube_side': torch.full((8,), 0.3),
               'hand_present': torch.ones(8, dtype=torch.bool)}
    torch.manual_seed(0)
    network = build('hand_dense', joints=21, width=4, bottleneck=8).requires_grad_(False).eval()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    tuned = fine_tune(network, samples, samples, 48, at_once)
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    assert all(torch.equal(value, before[name]) for name, value in tuned.state_dict().items() if 'running' in name)
    off = [(each(samples['patch']) - samples['joints']).norm(dim=-1).mean() for each in (network, tuned)]
    assert off[1] < 0.9 * off[0]
    monkeypatch.setattr(adapt, 'WAY', 0.0)  # of the way to what was learned
    still = fine_tune(network, samples, samples, 2, at_once).state_dict()
    assert all(torch.equal(value, before[name]) for name, value in still.items())


GOOD = {'found': 1.0, 'error_mm': None, 'disagreement_mm': 6.0, 'jitter_mm': 3.0, 'bone_drift_mm': 4.0,
        'explained': 0.6}


@pytest.mark.parametrize(('change', 'better'), [
    ({'disagreement_mm': 5.0}, True), ({'disagreement_mm': 5.0, 'explained': 0.5}, False),
    ({'disagreement_mm': 6.5, 'explained': 0.7}, False), ({'disagreement_mm': 5.0, 'found': 0.9}, False)])
def test_agreement_alone_is_not_better(change, better):
    assert is_better(GOOD, {**GOOD, **change}) == better


def test_the_truth_decides_where_it_is_known():
    before, after = {**GOOD, 'error_mm': 12.0}, {**GOOD, 'error_mm': 12.5, 'disagreement_mm': 3.0, 'explained': 0.9}
    assert not is_better(before, after) and is_better(after, before)
    assert not is_better(before, {**after, 'error_mm': 11.0, 'found': 0.98})  # by leaving out what is difficult

"""A checkpoint gives back what was saved, and says in one sentence why it cannot."""

import json
import pickle
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from hand_pose_ros import __version__
from hand_pose_ros.errors import CheckpointError
from hand_pose_ros.models import build, checkpoints
from hand_pose_ros.models.checkpoints import available, load_checkpoint, save_checkpoint

METADATA = {'skeleton': 'hand21', 'cube_side': 0.3}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A checkpoint of a small dense network and a refiner."""
    torch.manual_seed(0)
    path = tmp_path / 'small.safetensors'
    save_checkpoint(path, build('hand_dense', width=8), {**METADATA, 'note': 'made by a test'},
                    refiner=build('or_ref', hidden=(8,)))
    return path


def rewrite(path: Path, change) -> None:
    """Apply `change(metadata, tensors)` to a file, with the means of safetensors alone."""
    with safe_open(path, framework='pt') as opened:
        metadata = json.loads(opened.metadata()['hand_pose_ros'])
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    change(metadata, tensors)
    save_file(tensors, path, metadata={'hand_pose_ros': json.dumps(metadata)})


@pytest.mark.parametrize('architecture', ['deep_prior', 'multi_scale', 'resnet'])
def test_weights_that_half_precision_can_hold_come_back_unchanged(architecture, tmp_path):
    network = build(architecture, joints=14).eval()
    for weights in network.parameters():
        weights.data = weights.half().float()
    path = tmp_path / 'new folder' / 'x.safetensors'
    save_checkpoint(path, network, {'skeleton': 'nyu14', 'cube_side': 0.25, 'seed': 3})
    loaded = load_checkpoint(path)
    patches = torch.rand(2, 1, 128, 128)
    assert torch.equal(loaded.network(patches), network(patches))
    assert not loaded.network.training
    assert loaded.refiner is None
    assert loaded.metadata['architecture'] == architecture
    assert loaded.metadata['config']['joints'] == 14
    assert (loaded.metadata['skeleton'], loaded.metadata['cube_side'], loaded.metadata['seed']) == ('nyu14', 0.25, 3)


def test_half_precision_halves_the_file_and_hardly_moves_a_joint(tmp_path):
    torch.manual_seed(0)
    network = build('deep_prior').eval()
    path = tmp_path / 'half.safetensors'
    save_checkpoint(path, network, METADATA)
    assert path.stat().st_size < 0.51 * sum(weights.nbytes for weights in network.parameters())
    loaded = load_checkpoint(path).network
    assert all(p.dtype == torch.float32 for p in loaded.parameters())
    patches = torch.rand(4, 1, 128, 128) * 2 - 1
    scale = network(patches).abs().max()
    assert (loaded(patches) - network(patches)).abs().max() < 5e-3 * scale


def test_network_and_refiner_travel_together(file):
    loaded = load_checkpoint(file)
    assert loaded.metadata['note'] == 'made by a test'
    assert loaded.refiner is not None
    patches = torch.rand(1, 1, 128, 128)
    assert loaded.refiner(patches, loaded.network(patches)).shape == (1, 21, 3)


def test_running_statistics_keep_their_range(tmp_path):
    network = build('hand_dense', width=8)
    network.stem[0][1].running_var.fill_(1e6)  # beyond the largest half
    save_checkpoint(tmp_path / 'x.safetensors', network, METADATA)
    assert load_checkpoint(tmp_path / 'x.safetensors').network.stem[0][1].running_var[0] == 1e6


def test_an_interrupted_save_leaves_the_old_file(file, monkeypatch):
    before = file.read_bytes()

    def fail(tensors, path, metadata):
        Path(path).write_bytes(b'half of')
        raise OSError('disk full')

    monkeypatch.setattr(checkpoints, 'save_file', fail)
    with pytest.raises(OSError, match='disk full'):
        save_checkpoint(file, build('shallow'), METADATA)
    assert file.read_bytes() == before
    assert list(file.parent.iterdir()) == [file]


def test_checkpoints_are_found_by_name_and_by_path(file, monkeypatch):
    monkeypatch.setattr(checkpoints, 'WEIGHTS', file.parent)
    assert available() == {'small': file}
    assert load_checkpoint('small').metadata['note'] == 'made by a test'
    assert load_checkpoint(str(file)).metadata['note'] == 'made by a test'
    with pytest.raises(CheckpointError, match="no checkpoint named 'large': the ones that ship are small"):
        load_checkpoint('large')
    monkeypatch.setenv('HOME', str(file.parent))
    assert load_checkpoint('~/small.safetensors').metadata['note'] == 'made by a test'
    for missing in (file.parent / 'nowhere.safetensors', 'nowhere.safetensors', 'nowhere/small'):
        with pytest.raises(CheckpointError, match=f'no checkpoint file .*{missing}'):
            load_checkpoint(missing)


def test_what_a_checkpoint_is_comes_from_its_network_whatever_it_grew_from(file, tmp_path):
    grown = tmp_path / 'grown.safetensors'
    save_checkpoint(grown, build('shallow'), {**load_checkpoint(file).metadata, 'version': '0'})
    metadata = load_checkpoint(grown).metadata
    assert metadata['architecture'] == 'shallow' and metadata['version'] == __version__


def test_every_checkpoint_that_ships_loads():
    for name in available():
        load_checkpoint(name)
    if available():
        load_checkpoint()


class _Trap:
    def __reduce__(self):
        return Path.write_text, (Path('trap-was-run'), '')


@pytest.mark.parametrize('write', [
    lambda path: path.write_bytes(pickle.dumps(_Trap())), lambda path: torch.save({'x': _Trap()}, path)])
def test_pickles_are_refused_unread(write, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / 'x.pth')
    with pytest.raises(CheckpointError, match='is a pickle'):
        load_checkpoint(tmp_path / 'x.pth')
    assert not (tmp_path / 'trap-was-run').exists()


def test_a_header_whose_length_looks_like_a_pickle_is_none(tmp_path):
    path, network = tmp_path / 'x.safetensors', build('deep_prior')
    save_checkpoint(path, network, {**METADATA, 'note': ''})
    missing = (0x80 - path.read_bytes()[0]) % 256  # the file begins with the length of its header
    save_checkpoint(path, network, {**METADATA, 'note': 'x' * missing})
    assert path.read_bytes()[:1] == b'\x80'
    assert load_checkpoint(path).metadata['note'] == 'x' * missing
    data = bytearray(path.read_bytes())
    data[8:40] = bytes(32)
    path.write_bytes(data)
    with pytest.raises(CheckpointError, match='damaged'):
        load_checkpoint(path)


@pytest.mark.parametrize('damage', [
    lambda data: data[:len(data) // 2], lambda data: b'', lambda data: b'\xff' * 64, lambda data: data[:9]])
def test_a_damaged_file_says_so(damage, file):
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(CheckpointError, match='damaged or no safetensors file'):
        load_checkpoint(file)


@pytest.mark.parametrize(('change', 'sentence'), [
    (lambda m, t: m.update(architecture='unheard_of'), "unknown architecture 'unheard_of'"),
    (lambda m, t: m['config'].update(depth=9), 'does not take depth'),
    (lambda m, t: m.pop('cube_side'), 'does not say its cube_side'),
    (lambda m, t: m.pop('version'), 'does not say its version: copy or download it again'),
    (lambda m, t: m.update(cube_side='0.3'), "its cube_side is '0.3', where metres belong"),
    (lambda m, t: m.update(cube_side=0), 'its cube_side is 0, where metres belong'),
    (lambda m, t: m.update(skeleton='nyu14'), "predicts 21 joints, but its skeleton 'nyu14' has 14"),
    (lambda m, t: m.update(skeleton='octopus'), "unknown skeleton 'octopus'"),
    (lambda m, t: m['config'].update(width=16), 'instead of .*: copy or download it again'),
    (lambda m, t: t.pop('network.maps.bias'), "lacks the weights 'maps.bias' of its network: copy or download it"),
    (lambda m, t: t.pop('refiner.biases.0'), "lacks the weights 'biases.0' of its refiner"),
    (lambda m, t: t.update({'network.more': torch.zeros(1)}), "holds 'more', which its network has no place for: copy"),
    (lambda m, t: t['network.maps.bias'].fill_(float('nan')), "'maps.bias' of its network is not finite"),
])
def test_a_file_that_does_not_fit_says_why(change, sentence, file):
    rewrite(file, change)
    with pytest.raises(CheckpointError, match=sentence):
        load_checkpoint(file)


def test_foreign_safetensors_are_refused(tmp_path):
    save_file({'weight': torch.zeros(1)}, tmp_path / 'x.safetensors')
    with pytest.raises(CheckpointError, match='was not written by hand_pose_ros'):
        load_checkpoint(tmp_path / 'x.safetensors')


def test_what_cannot_be_used_is_not_written(tmp_path):
    network = build('shallow')
    with pytest.raises(CheckpointError, match='lacks cube_side'):
        save_checkpoint(tmp_path / 'x.safetensors', network, {'skeleton': 'hand21'})
    with torch.no_grad():
        network.head.output.bias[0] = float('inf')
    with pytest.raises(CheckpointError, match=r"'network\.head\.output\.bias' holds values that are not finite"):
        save_checkpoint(tmp_path / 'x.safetensors', network, METADATA)
    assert not list(tmp_path.iterdir())

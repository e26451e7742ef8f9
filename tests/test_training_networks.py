"""What each kind of network is trained from: a prior of poses, a base, and samples that its base has not seen."""

import json
from dataclasses import replace

import pytest
import torch
from test_training import TINY, folder, record_hand, tiny  # noqa: F401 (folder is a fixture)
from torch import nn

from hand_pose_ros.errors import HandPoseError, TrainingError
from hand_pose_ros.models import build
from hand_pose_ros.models.checkpoints import load_checkpoint, save_checkpoint
from hand_pose_ros.models.prior import fit_prior
from hand_pose_ros.models.two_looks import ZOOM
from hand_pose_ros.skeleton import SKELETONS, get_skeleton
from hand_pose_ros.training.augmentation import Augmentation, augment
from hand_pose_ros.training.loop import Machine, Run
from hand_pose_ros.training.recipes import get_recipe

# ruff: noqa: F811 (a fixture from another file is imported, and then an argument)

pytestmark = pytest.mark.usefixtures('one_thread')


def test_the_prior_comes_from_the_training_poses_and_is_trained_on_unless_the_recipe_says_no(folder, tmp_path):
    for recipe, trained_on in (('paper', True), ('original-code', False)):
        run = tiny(folder, 'samples=16', 'augmentation=none', recipe=recipe, out=tmp_path / recipe)
        # Of all training samples: the first ones of a recording may be one gesture of one person.
        prior = fit_prior(torch.cat([run.shards.read(shard)['joints'] for shard in range(4)]), 8)
        head = run.objective.network.head
        start = head.reconstruction.weight.detach().clone()
        torch.testing.assert_close(start.T.double(), torch.from_numpy(prior.components.copy()), atol=1e-5, rtol=0)
        mean = torch.from_numpy(prior.mean)
        torch.testing.assert_close(head.reconstruction.bias.detach().double(), mean, atol=1e-6, rtol=0)
        run.train()
        assert torch.equal(head.reconstruction.weight.detach(), start) != trained_on
    # And where the network has a bottleneck of its own, of 30, that nobody asked for.
    run = tiny(folder, 'network=deep_prior', 'options={}', 'samples=16', out=tmp_path / 'unasked')
    components = run.objective.network.head.reconstruction.weight.T
    torch.testing.assert_close(components @ components.T, torch.eye(30), atol=1e-5, rtol=0)


def test_bags_of_another_folder_were_not_seen_by_the_base(tmp_path):
    def run(folder: str, *overrides: str) -> Run:
        recipe = get_recipe('paper', [*TINY, 'dataset=bags', 'options.bottleneck=none', f'root={tmp_path / folder}',
                                      *overrides])
        return Run(tmp_path / 'run', recipe, Machine(tmp_path / 'cache', workers=0))
    for name in ('first', 'second'):
        record_hand(tmp_path / name / 'train')
        record_hand(tmp_path / name / 'val')
    first = run('first', 'batch_size=1', 'samples=1')
    first.train()
    base = f'base={first.folder.checkpoint("last")}'
    with pytest.raises(TrainingError, match='trained on all of bags-train'):
        run('first', 'refiner=or_ref', base)
    assert list(run('second', 'refiner=or_ref', base).stream.window(0)) == [0]


def test_a_refiner_learns_from_what_its_base_has_not_seen(folder, tmp_path):
    tiny(folder, out=tmp_path / 'greedy', ).train()
    with pytest.raises(TrainingError, match=r'trained on all of icvl-train.*last_shard=N'):
        tiny(folder, 'refiner=or_ref', f'base={tmp_path / "greedy" / "last.safetensors"}', out=tmp_path / 'never')
    tiny(folder, 'last_shard=2', out=tmp_path / 'base').train()
    base = tmp_path / 'base' / 'last.safetensors'
    with pytest.raises(TrainingError, match='choose one of std_ref, or_ref'):
        tiny(folder, 'refiner=deep', f'base={base}', out=tmp_path / 'never')
    with pytest.raises(TrainingError, match=r'or_ref corrects .* --set refiner=or_ref'):
        tiny(folder, 'network=or_ref', 'options={}', out=tmp_path / 'never')
    with pytest.raises(TrainingError, match=r'gives joints of hand21, but icvl has those of icvl16'):
        tiny(folder, 'refiner=or_ref', 'base=deep_prior', out=tmp_path / 'never')
    with pytest.raises(HandPoseError, match='does not take width'):
        tiny(folder, 'refiner=or_ref', f'base={base}', 'options.width=8', out=tmp_path / 'never')
    run = tiny(folder, 'refiner=or_ref', f'base={base}', 'optimizer=adamw', 'learning_rate=0.001', 'samples=160',
               'options.dropout=0.2', out=tmp_path / 'refined')
    assert list(run.stream.window(0)) == [2, 3]
    other = tiny(folder, 'refiner=or_ref', f'base={base}', 'shard_size=3', out=tmp_path / 'never')
    assert list(other.stream.window(0)) == [3, 4, 5]  # of 16 samples, of which the base has seen 8
    tiny(folder, 'last_shard=1', 'samples=4', f'base={base}', out=tmp_path / 'on').train()  # what its base saw, it saw
    behind = tiny(folder, 'refiner=or_ref', f'base={tmp_path / "on" / "last.safetensors"}', out=tmp_path / 'never')
    assert list(behind.stream.window(0)) == [2, 3]
    run.train()
    assert 'or_ref on icvl-train' in (tmp_path / 'refined' / 'log.txt').read_text()
    refined, before = load_checkpoint(tmp_path / 'refined' / 'last.safetensors'), load_checkpoint(base)
    assert refined.refiner.config['dropout'] == 0.2
    kept = refined.network.state_dict()
    assert all(torch.equal(kept[key], value) for key, value in before.network.state_dict().items())
    batch = run.shards.read(3)
    with torch.no_grad():
        estimate = refined.network(batch['patch'].float())
        better = refined.refiner(batch['patch'].float(), estimate)
    assert (better - batch['joints']).norm(dim=-1).mean() < (estimate - batch['joints']).norm(dim=-1).mean()
    with pytest.raises(TrainingError, match='--set base=FILE'):
        tiny(folder, 'refiner=or_ref', out=tmp_path / 'never')


def test_a_base_without_joints_is_refused_as_that_of_a_refiner(folder, tmp_path):
    tiny(folder, 'network=center_refiner', 'options={}', 'last_shard=2', 'samples=4', out=tmp_path / 'palm').train()
    with pytest.raises(TrainingError, match='is a center_refiner, which gives no joints to correct'):
        tiny(folder, 'refiner=or_ref', f'base={tmp_path / "palm" / "last.safetensors"}', out=tmp_path / 'never')


def test_the_center_refiner_learns_where_the_palm_is(folder, tmp_path):
    run = tiny(folder, 'network=center_refiner', 'options={}', 'options.dropout=0.0', 'optimizer=adamw',
               'learning_rate=0.001', 'samples=600', out=tmp_path)
    run.train()
    network = load_checkpoint(tmp_path / 'last.safetensors').network
    batch = run.shards.read(0)
    palm = batch['joints'][:, 0]  # of icvl16
    with torch.no_grad():
        error = (network(batch['patch'].float()) - palm).norm(dim=-1).mean()
    assert error < 0.5 * (palm - palm.mean(0)).norm(dim=-1).mean()


def test_the_finder_of_hands_learns_from_whole_scenes(folder, tmp_path):
    recipe = get_recipe('finder', ['samples=1920', 'batch_size=16', 'shard_size=32', 'reuse=60', 'val_samples=32',
                                   'precision=float32', 'options.width=8', 'learning_rate=0.01', 'average=0.9'])
    run = Run(tmp_path / 'run', recipe, Machine(tmp_path / 'cache', workers=0))
    run.train()
    terms = [row for row in map(json.loads, (tmp_path / 'run' / 'metrics.jsonl').open()) if 'score' in row]
    network = load_checkpoint(tmp_path / 'run' / 'last.safetensors').network
    shown = run.shards.read(0)
    with torch.no_grad():
        logits, middles = network(shown['patch'].float())
    best = logits.flatten(1).argmax(1)
    found = middles.flatten(2)[torch.arange(len(best)), :, best]
    off = (found - shown['joints'][:, 0])[shown['hand_present']].norm(dim=1)
    assert terms and off.median() < 0.15  # of scenes that reach half a metre to each side
    with pytest.raises(TrainingError, match='dataset=scenes'):
        tiny(folder, 'network=hand_finder', 'options={}', out=tmp_path / 'never')


def test_a_network_starts_from_another_and_gets_a_prior_if_that_had_none(folder, tmp_path, monkeypatch):
    plain = tmp_path / 'plain.safetensors'
    facts = {'skeleton': 'icvl16', 'cube_side': 0.3}
    save_checkpoint(plain, build('hand_dense', joints=16, width=8), facts)
    wanted = ('network=hand_dense', 'options.width=8')
    run = tiny(folder, *wanted, f'base={plain}', out=tmp_path / 'first')
    first = run.objective.network
    patch = run.shards.read(0)['patch'].float()
    with torch.no_grad():
        answer = first.eval().forward_full(patch)
        same = load_checkpoint(plain).network.forward_full(patch)
    torch.testing.assert_close(answer['votes'], same['joints'], atol=1e-5, rtol=0)
    gram = first.head.projection.weight @ first.head.reconstruction.weight
    torch.testing.assert_close(gram, torch.eye(8), atol=1e-5, rtol=0)  # of principal components
    first.head.output.bias.data.fill_(0.1)
    path = tmp_path / 'with.safetensors'
    save_checkpoint(path, first, facts)
    second = tiny(folder, *wanted, f'base={path}', out=tmp_path / 'second').objective.network
    pairs = zip(load_checkpoint(path).network.state_dict().values(), second.state_dict().values(), strict=True)
    assert all(torch.equal(one, other) for one, other in pairs)
    with pytest.raises(TrainingError, match='holds another network than the recipe names'):
        tiny(folder, f'base={path}', out=tmp_path / 'third')
    # As many joints, but others: neither they nor their prior would be those of the dataset.
    save_checkpoint(path, first, {**facts, 'skeleton': 'other16'})
    monkeypatch.setitem(SKELETONS, 'other16', replace(get_skeleton('icvl16'), name='other16'))
    with pytest.raises(TrainingError, match='gives joints of other16, but icvl has those of icvl16'):
        tiny(folder, *wanted, f'base={path}', out=tmp_path / 'fourth')
    with pytest.raises(TrainingError, match='needs a hand_dense with the joints of icvl16'):
        tiny(folder, 'network=two_looks', f'first={path}', out=tmp_path / 'fifth')


def test_a_network_with_further_blocks_and_a_refinement_starts_as_the_one_it_grew_from(folder, tmp_path):
    facts, base = {'skeleton': 'icvl16', 'cube_side': 0.3}, tmp_path / 'base.safetensors'
    network = build('hand_dense', joints=16, width=8, bottleneck=8)
    for norm in (part for part in network.modules() if isinstance(part, nn.BatchNorm2d)):
        nn.init.uniform_(norm.weight, 0.5, 1)  # as after training: none is zero
    save_checkpoint(base, network, facts)
    wanted = ('network=hand_dense', 'options.width=8', f'base={base}')
    run = tiny(folder, *wanted, 'options.blocks=[1,2,1,3]', 'options.refined=true', 'samples=40', recipe='modern',
               out=tmp_path / 'grown')
    patch = run.shards.read(0)['patch'].float()
    with torch.no_grad():
        answers = [each.forward_full(patch) for each in (run.objective.network.eval(), load_checkpoint(base).network)]
    for name in answers[1]:
        torch.testing.assert_close(answers[0][name], answers[1][name], atol=1e-5, rtol=0)
    run.train()
    grown = load_checkpoint(tmp_path / 'grown' / 'last.safetensors').network
    assert grown.config['blocks'] == [1, 2, 1, 3] and grown.stages[3][2].body[2][1].weight.abs().max() > 0
    assert grown.config['refined'] and grown.refinement.output.weight.abs().max() > 0
    for other in ('options.blocks=[2,1,1]', 'options.blocks=[1,0,1,1]'):
        with pytest.raises(HandPoseError, match='give four numbers'):
            tiny(folder, *wanted, other, out=tmp_path / 'never')
    with pytest.raises(TrainingError, match='holds another network'):  # fewer blocks than its base has
        tiny(folder, 'network=hand_dense', 'options.width=8', f'base={tmp_path / "grown" / "last.safetensors"}',
             out=tmp_path / 'fewer')


def test_the_second_look_learns_behind_a_first_which_stays(folder, tmp_path):
    facts = {'skeleton': 'icvl16', 'cube_side': 0.3}
    small, large = tmp_path / 'small.safetensors', tmp_path / 'large.safetensors'
    save_checkpoint(small, build('hand_dense', joints=16, width=4, bottleneck=8), facts)
    save_checkpoint(large, build('hand_dense', joints=16, width=8, bottleneck=8), facts)
    wanted = ('network=two_looks', 'options.width=8', 'options.bottleneck=8')
    for base in ('none', large):
        with pytest.raises(TrainingError, match='--set first=FILE'):
            tiny(folder, *wanted, f'base={base}', out=tmp_path / 'never')
    with pytest.raises(TrainingError, match='hand_dense has one look'):
        tiny(folder, 'network=hand_dense', *wanted[1:], f'first={small}', out=tmp_path / 'never')
    run = tiny(folder, *wanted, f'first={small}', f'base={large}', 'samples=40', recipe='modern', out=tmp_path / 'run')
    network, base = run.objective.network, load_checkpoint(large).network.state_dict()
    assert network.config['knuckles'] == (4, 7, 10, 13) and network.config['first'] == {
        'width': 4, 'bottleneck': 8, 'blocks': [1, 1, 1, 1], 'refined': False}
    second = network.second.state_dict()
    equal = {name for name in base if torch.equal(base[name], second[name])}
    assert all(name.startswith('head.') for name in base.keys() - equal) and len(equal) < len(base)
    # The prior is one of poses as they are seen: upright.
    mean = network.second.head.reconstruction.bias.detach().view(16, 3)
    assert mean[:, :2].mean(0).abs().max() < 0.02
    assert mean[list(network.knuckles), 1].mean() < mean[0, 1] - 0.05
    # The bones of these joints begin at the palm: hands are shown as if all had the usual size.
    batch = augment(run.shards.read(0), Augmentation(), torch.arange(4), seed=0)
    apart, seen = (torch.cdist(poses, poses) for poses in (batch['joints'], run.objective.poses(batch)))
    torch.testing.assert_close(seen * ZOOM, apart, atol=1e-4, rtol=1e-4)
    run.train()
    last = tmp_path / 'run' / 'last.safetensors'
    trained, kept = load_checkpoint(last).network.state_dict(), load_checkpoint(small).network.state_dict()
    assert all(torch.equal(trained[f'first.{name}'], value) for name, value in kept.items())
    assert not torch.equal(trained['second.maps.weight'], base['maps.weight'])
    # What the first has seen, both have: a refiner of them begins behind that.
    save_checkpoint(small, load_checkpoint(small).network, {**facts, 'training_data': 'icvl-train',
                                                            'training_shards': 3, 'recipe': {'shard_size': 4}})
    tiny(folder, *wanted, f'first={small}', 'last_shard=2', 'samples=4', out=tmp_path / 'behind').train()
    assert load_checkpoint(tmp_path / 'behind' / 'last.safetensors').metadata['training_shards'] == 3
    # And on, from two looks; or with another first.
    again = tiny(folder, *wanted, f'base={last}', out=tmp_path / 'again').objective.network.state_dict()
    assert all(torch.equal(value, trained[name]) for name, value in again.items())
    other = tiny(folder, *wanted, f'base={last}', f'first={large}', 'train_prior=false', out=tmp_path / 'other')
    other = other.objective.network
    assert torch.equal(other.first.maps.weight, base['maps.weight'])
    assert torch.equal(other.second.maps.weight, trained['second.maps.weight'])
    assert not other.second.head.reconstruction.weight.requires_grad

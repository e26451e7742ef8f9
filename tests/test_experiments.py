"""What `hand-pose experiment` promises: what is missing is trained, once, and table, plot and numbers come out."""

import json
from dataclasses import replace

import cv2
import pytest
from test_training import TINY, folder, stop_after  # noqa: F401 (folder is a fixture)

from hand_pose_ros.cli import main
from hand_pose_ros.cli.experiment import NAMES
from hand_pose_ros.errors import TrainingError
from hand_pose_ros.models.checkpoints import load_checkpoint
from hand_pose_ros.training import experiments
from hand_pose_ros.training.loop import Machine, Run
from hand_pose_ros.training.recipes import get_recipe

# ruff: noqa: F811 (a fixture from another file is imported, and then an argument)

pytestmark = pytest.mark.usefixtures('one_thread')


@pytest.mark.timeout(600)
def test_experiments_train_what_is_missing_and_write_table_plot_and_json(folder, tmp_path, monkeypatch):
    assert tuple(experiments.EXPERIMENTS) == NAMES
    monkeypatch.setattr(experiments, 'WIDTHS', (None, 8, 30))
    monkeypatch.setattr(experiments, 'ITERATIONS', 2)
    monkeypatch.setattr(experiments, 'ROUNDS', 1)
    monkeypatch.setattr(experiments, 'TEST_SAMPLES', 4)  # fewer than there are recorded ones: those are all taken
    changes = (*TINY, 'options.dropout=0.1', f'root={folder}', 'samples=24', 'last_shard=3')
    sets = [part for item in changes for part in ('--set', item)]
    recipe = get_recipe('paper', changes)
    begun = Run(tmp_path / 'runs' / 'deep-8', replace(
        recipe, network='deep', options={**recipe.options, 'bottleneck': 8}), Machine(folder / 'cache', workers=0))
    stop_after(begun, 3)
    with pytest.raises(TrainingError, match='an experiment goes on by the same command'):
        begun.train()
    monkeypatch.chdir(tmp_path.parent)
    arguments = ['--out', tmp_path.name, '--workers', '0', '--threads', '1', *sets]
    for name in ('bottleneck', 'refinement', 'joints', 'qualitative', 'runtime'):
        assert main(['experiment', name, *arguments]) == 0
        assert json.loads((tmp_path / f'{name}.json').read_text())['recipe']['samples'] == 24
        assert cv2.imread(str(tmp_path / f'{name}.png')).std() > 5
        assert (tmp_path / f'{name}.md').read_text().count('|') > 20
    assert {path.name for path in tmp_path.iterdir()} == {'runs', *(
        f'{name}.{form}' for name in ('bottleneck', 'bottleneck-curves', 'refinement', 'refinement-curves', 'joints',
                                      'qualitative', 'runtime') for form in ('json', 'md', 'png', 'svg'))}
    runs = {path.name: (path / 'state.safetensors').stat().st_mtime_ns for path in (tmp_path / 'runs').iterdir()}
    assert runs.keys() == {'deep-direct', 'deep-8', 'deep-30', 'deep-30-std_ref', 'deep-30-or_ref'}
    assert load_checkpoint(tmp_path / 'runs' / 'deep-8' / 'last.safetensors').network.config == {
        'joints': 16, 'bottleneck': 8, 'dropout': 0.1}
    results = json.loads((tmp_path / 'refinement.json').read_text())['results']
    assert [result['name'] for result in results] == [
        'deep-30', 'deep-30 + std_ref x1', 'deep-30 + std_ref x2', 'deep-30 + or_ref x1', 'deep-30 + or_ref x2']
    assert len({result['mean_mm'] for result in results}) == 5 and all(result['frames'] == 6 for result in results)
    told = {name: json.loads((tmp_path / f'{name}.json').read_text()) for name in ('joints', 'runtime')}
    twice = told['joints']['results'][2]
    assert twice['name'] == 'deep-30 + or_ref x2' and twice['mean_mm'] == pytest.approx(results[4]['mean_mm'])
    within = ''.join(f' {100 * twice["within_mm"][mm]:.1f} % |' for mm in ('20', '30', '40', '80'))
    assert (tmp_path / 'joints.md').read_text().splitlines()[-1] == (
        f'| deep-30 + or_ref x2 | {twice["mean_mm"]:.2f} | {twice["median_mm"]:.2f} |{within}')
    slow, fast = (told['runtime']['rows'][f'deep|{way}']['p50_ms'] for way in ('eager', 'fast'))
    assert f'| deep | 0.1 | 2.08 | {slow:.2f} | {fast:.2f} |' in (tmp_path / 'runtime.md').read_text()

    monkeypatch.chdir(tmp_path)
    arguments[1] = str(tmp_path)
    for name in ('bottleneck', 'joints'):  # again, and from elsewhere: nothing is trained twice
        assert main(['experiment', name, *arguments]) == 0
    assert all((tmp_path / 'runs' / run / 'state.safetensors').stat().st_mtime_ns == at for run, at in runs.items())
    assert main(['experiment', 'bottleneck', *arguments, '--set', 'knee=0.2']) == 1  # but never another recipe


def test_an_experiment_that_leaves_nothing_for_the_refiner_is_refused_at_once(folder, tmp_path, capsys):
    sets = [part for item in (*TINY, f'root={folder}', 'samples=24') for part in ('--set', item)]
    assert main(['experiment', 'joints', '--out', str(tmp_path), '--workers', '0', *sets]) == 1
    assert 'some of the 4 shards of icvl-train to it, for example with --set last_shard=3' in capsys.readouterr().err
    assert main(['experiment', 'ingredients', '--out', str(tmp_path), '--workers', '0', *sets]) == 1
    assert '--set dataset=icvl: only synthetic hands have ingredients to leave out' in capsys.readouterr().err
    assert not (tmp_path / 'runs').exists()

"""The `hand-pose` command as a whole: every verb explains itself, and the exit codes mean what they say."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hand_pose_ros.cli import VERBS, main
from hand_pose_ros.resources import resource
from hand_pose_ros.synthetic.sensors import SENSORS


@pytest.mark.parametrize('verb', VERBS)
def test_every_verb_has_help_with_examples(verb, capsys):
    with pytest.raises(SystemExit) as exit_:
        main([verb, '--help'])
    assert exit_.value.code == 0
    assert f'hand-pose {verb}' in capsys.readouterr().out.split('examples:')[1]


@pytest.mark.parametrize(('arguments', 'remedy'), [
    (['synth', 'write', 'hands', '--number', '1'], '--device cpu'), (['train', 'paper', '--out', 'run'], 'batch_size')])
def test_a_gpu_without_enough_memory_is_told(arguments, remedy, monkeypatch, tmp_path, capsys):
    def full(device):
        raise torch.cuda.OutOfMemoryError('CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has 1 GiB.')
    monkeypatch.chdir(tmp_path)
    for where in ('cli.synth', 'training.loop', 'training.distributed'):
        monkeypatch.setattr(f'hand_pose_ros.{where}.check_device', full)
    assert main([*arguments, '--device', 'cuda']) == 1
    said = capsys.readouterr().err
    assert said.startswith(f'hand-pose {arguments[0]}: CUDA out of memory: end other programs on the GPU')
    assert remedy in said and said.count('\n') == 1


def test_names_of_sensors_are_in_the_help(capsys):
    with pytest.raises(SystemExit):
        main(['synth', 'show', '--help'])
    text = capsys.readouterr().out
    assert all(sensor.name in text for sensor in SENSORS)


def test_the_list_of_verbs_is_complete(capsys):
    with pytest.raises(SystemExit):
        main(['--help'])
    text = capsys.readouterr().out
    assert all(verb in text for verb in VERBS)


@pytest.mark.parametrize('arguments', [[], ['no_such_verb'], ['--no-such-option', 'doctor'], ['estimate'],
                                       ['train', 'modern', '--out', 'x', '--workers', '-1'],
                                       ['synth', 'show', 'x.png', '--split', 'val', '--start', '-1'],
                                       ['estimate', 'x', '--no-such-option'], ['evaluate'],
                                       ['evaluate', 'a.mcap', '--side', 'up'], ['train', 'modern']])
def test_bad_arguments_are_exit_code_2_and_one_sentence(arguments, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    error = capsys.readouterr().err
    assert exit_.value.code == 2 and error.startswith('hand-pose') and error.count('\n') == 1


def test_parameters_of_the_node_are_not_options_of_the_command(capsys):
    with pytest.raises(SystemExit) as exit_:
        main(['estimator', '--detector', 'nearest'])
    assert exit_.value.code == 2
    assert '--detector nearest; parameters are set with --ros-args -p NAME:=VALUE' in capsys.readouterr().err


def test_failure_is_exit_code_1_and_one_sentence(tmp_path, capsys):
    assert main(['estimate', str(tmp_path / 'no_such_folder'), '--out', 'joints.npz']) == 1
    error = capsys.readouterr().err
    assert 'no_such_folder' in error and error.count('\n') == 1


def test_listing_the_verbs_loads_no_heavy_library():
    code = ("import sys; from hand_pose_ros.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
            "assert not {'torch', 'cv2', 'rclpy', 'matplotlib'} & set(sys.modules)")
    subprocess.run([sys.executable, '-c', code], check=True, capture_output=True)


@pytest.mark.parametrize(('option', 'wanted'), [
    ('--max-hands', 'a whole number'), ('--depth-scale', 'a number'), ('--cube-size', 'a number'),
    ('--min-score', 'a number'), ('--intrinsics', 'a number')])
def test_text_where_a_number_belongs_is_told_in_plain_words(option, wanted, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(['estimate', 'x', option, *['many'] * (4 if option == '--intrinsics' else 1)])
    assert exit_.value.code == 2
    assert f'argument {option}: many is not {wanted} (' in capsys.readouterr().err


@pytest.mark.skipif(sys.platform != 'linux', reason='elsewhere there is always a display')
def test_to_view_without_a_display_is_refused_at_once(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'rerun', SimpleNamespace(blueprint=None))  # as if it were installed
    for name in ('DISPLAY', 'WAYLAND_DISPLAY'):
        monkeypatch.delenv(name, raising=False)
    bag = Path(__file__).parents[1] / 'demo' / 'hand.mcap'
    assert main(['view', str(bag)]) == 1
    assert 'there is no display for the viewer: write a file with --save FILE.rrd' in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, 'rerun', None)  # else who then says --save only learns that Rerun is missing
    assert main(['view', str(bag)]) == 1
    assert "'.[view]'" in capsys.readouterr().err


@pytest.mark.parametrize('unbuffered', ['', '1'])
def test_output_that_cannot_be_printed_is_one_sentence(unbuffered):
    pytest.importorskip('rclpy', reason='the verb estimator needs ROS 2')
    command = [sys.executable, '-m', 'hand_pose_ros.cli', 'estimator', '--parameters']
    with open('/dev/full', 'w') as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True,
                              env={**os.environ, 'PYTHONUNBUFFERED': unbuffered})
    assert done.returncode == 1 and 'No space left' in done.stderr and done.stderr.count('\n') == 1


def test_a_reader_that_leaves_early_is_one_sentence():
    pytest.importorskip('rclpy', reason='the verb estimator needs ROS 2')
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run([sys.executable, '-m', 'hand_pose_ros.cli', 'estimator', '--parameters'], stdout=writing,
                          stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (done.returncode, done.stderr) == (1, 'hand-pose estimator: standard output: Broken pipe\n')


@pytest.mark.parametrize('of_c', [False, True])
def test_ctrl_c_while_a_verb_is_loaded_is_one_sentence(of_c, monkeypatch, capsys):
    """Modules in C, as those of ONNX Runtime, make an ImportError of it."""
    def find_spec(name, *_):
        if name == 'hand_pose_ros.cli.bench':
            raise (ImportError('initialization failed') if of_c else KeyboardInterrupt) from KeyboardInterrupt()
    monkeypatch.setattr(sys, 'meta_path', [SimpleNamespace(find_spec=find_spec), *sys.meta_path])
    monkeypatch.delitem(sys.modules, 'hand_pose_ros.cli.bench', raising=False)
    assert main(['bench']) == 1
    assert capsys.readouterr().err == 'hand-pose bench: interrupted\n'


def test_files_are_written_where_the_standard_streams_are_closed(tmp_path):
    command = [sys.executable, '-m', 'hand_pose_ros.cli', 'estimate', str(resource('demo/depth.png')), '--intrinsics',
               '364.5', '364.5', '256', '208', '--out', str(tmp_path / 'hand.npz')]
    done = subprocess.run(['bash', '-c', '"$@" <&- >&- 2>&-', 'bash', *command])
    assert done.returncode == 0
    with np.load(tmp_path / 'hand.npz') as file:
        assert len(file['joints']) == 1

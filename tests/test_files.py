"""What files promise: they appear in one step, and what cannot be written is said with its name."""

import os

import pytest

from hand_pose_ros.cli.arguments import keep_input
from hand_pose_ros.errors import InputError
from hand_pose_ros.files import check_writable, in_one_step, write_json


def test_a_folder_where_a_file_is_to_be_is_refused(tmp_path):
    with pytest.raises(InputError, match='is a folder'), in_one_step(tmp_path):
        pass
    assert not list(tmp_path.parent.glob('.*.part'))


def test_a_link_that_leads_to_itself_is_replaced(tmp_path):
    (tmp_path / 'loop').symlink_to('loop')
    keep_input(tmp_path / 'loop', tmp_path)
    check_writable(tmp_path / 'loop')
    write_json(tmp_path / 'loop', {})
    assert (tmp_path / 'loop').read_text() == '{}\n'


def test_a_file_behind_a_link_is_replaced_and_the_link_is_kept(tmp_path):
    (tmp_path / 'there').mkdir()
    (tmp_path / 'link.json').symlink_to('there/file.json')
    for value in (1, 2):
        write_json(tmp_path / 'link.json', value)
        assert (tmp_path / 'there' / 'file.json').read_text() == f'{value}\n' and (tmp_path / 'link.json').is_symlink()
    with pytest.raises(ValueError, match='JSON'):
        write_json(tmp_path / 'link.json', float('nan'))
    with pytest.raises(RuntimeError), in_one_step(tmp_path / 'link.json') as part:
        part.write_text('half')
        raise RuntimeError
    assert (tmp_path / 'link.json').read_text() == '2\n', 'after an error nothing has changed'
    assert [path.name for path in (tmp_path / 'there').iterdir()] == ['file.json']


def test_what_is_no_file_is_written_to_and_not_replaced(tmp_path):
    os.mkfifo(tmp_path / 'fifo')
    reading = os.open(tmp_path / 'fifo', os.O_RDONLY | os.O_NONBLOCK)
    check_writable(tmp_path / 'fifo')
    write_json(tmp_path / 'fifo', [])
    assert os.read(reading, 10) == b'[]\n' and (tmp_path / 'fifo').is_fifo()
    os.close(reading)


@pytest.mark.parametrize('said', ['No space left on device', 'database or disk is full', 'Disk quota exceeded'])
def test_a_full_disk_is_told_with_the_file(tmp_path, said):
    with pytest.raises(InputError, match=r'a\.json: cannot be written, for the disk is full'), \
            in_one_step(tmp_path / 'a.json'):
        raise OSError(said)
    assert not list(tmp_path.iterdir())

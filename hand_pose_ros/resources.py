"""Files that come with the package and are not Python: messages, parameters, launch and RViz files, the DDS profile."""

from pathlib import Path

from hand_pose_ros.errors import HandPoseError


def share_folder() -> Path:
    """The folder that holds package.xml and, beside it, msg/, config/, launch/ and rviz/.

    In a source tree (and an editable install) that is its root; installed by pip or colcon it is
    ``<prefix>/share/hand_pose_ros``.

    Raises:
        HandPoseError: the package was copied here without its files.
    """
    package = Path(__file__).absolute().parent  # not resolved: colcon --symlink-install links back into the source
    for folder in (package.parent, *(prefix / 'share' / package.name for prefix in package.parents)):
        if (folder / 'package.xml').is_file():
            return folder
    raise HandPoseError(f'there is no share/{package.name} with the files of the package above {package}: reinstall it')


def resource(name: str) -> Path:
    """Path of a file that comes with the package, wherever it is installed.

    Args:
        name: path inside the share folder, such as ``"config/estimator.yaml"`` or ``"msg/HandJoints.msg"``.

    Raises:
        HandPoseError: there is no such file.
    """
    path = share_folder() / name
    if not path.is_file():
        raise HandPoseError(f'{path} does not exist: reinstall the package with pip or colcon')
    return path

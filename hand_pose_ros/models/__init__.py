"""The networks: one file per family, one table of all architectures, and checkpoints."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any

from torch import nn

from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.models.dense import HandDense
from hand_pose_ros.models.finder import HandFinder
from hand_pose_ros.models.prior_net import CenterRefiner, Deep, MultiScale, Shallow
from hand_pose_ros.models.refiner import ORRef, StdRef
from hand_pose_ros.models.resnet import ResNet
from hand_pose_ros.models.two_looks import TwoLooks

ARCHITECTURES: dict[str, Callable[..., nn.Module]] = {
    'shallow': Shallow,
    'deep': Deep,
    'deep_prior': partial(Deep, bottleneck=30),
    'multi_scale': MultiScale,
    'resnet': ResNet,
    'hand_dense': HandDense,
    'two_looks': TwoLooks,
    'center_refiner': CenterRefiner,
    'hand_finder': HandFinder,
    'std_ref': StdRef,
    'or_ref': ORRef,
}
REFINERS = ('std_ref', 'or_ref')
"""The architectures that correct the joints of another network."""
NO_JOINTS = ('hand_finder', 'center_refiner', *REFINERS)
"""Those that predict no joints by themselves: they find hands, or refine the results of other networks."""


def build(architecture: str, **config: Any) -> nn.Module:
    """A network with fresh weights, by name. It remembers its `architecture` and its complete `config`.

    - Pose networks map patches (B, 1, 128, 128) to joints (B, J, 3) in cube units.
    - std_ref and or_ref map patches and joints to better joints.
    - center_refiner maps patches to the palm (B, 3).
    - hand_finder maps whole images to the middles of hands.

    Raises:
        HandPoseError: the architecture does not exist, or does not take a key or a value of `config`.
    """
    if architecture not in ARCHITECTURES:
        raise HandPoseError(f"unknown architecture '{architecture}': "
                            f"choose one of {', '.join(ARCHITECTURES)}")
    make = ARCHITECTURES[architecture]
    signature = inspect.signature(make)
    if unknown := sorted(config.keys() - signature.parameters.keys()):
        raise HandPoseError(f"architecture '{architecture}' does not take {', '.join(unknown)}: "
                            f"it takes {', '.join(signature.parameters)}")
    for name, value in config.items():
        if wanted := _wanted(value, signature.parameters[name]):
            raise HandPoseError(f'{architecture} cannot have {name}={value}: give {wanted}')
    arguments = signature.bind(**config)
    arguments.apply_defaults()  # a checkpoint must not depend on the defaults of the version that reads it
    try:
        network = make(**arguments.arguments)
    except (TypeError, ValueError, RuntimeError) as error:
        raise HandPoseError(f"architecture '{architecture}' cannot be made with {config}: {error}") from error
    vars(network).update(architecture=architecture, config=dict(arguments.arguments))
    return network


def _wanted(value: Any, parameter: inspect.Parameter) -> str:
    """What to give instead of a value of the wrong type or out of range. It is empty if the value may do."""
    kind, default = parameter.annotation, parameter.default
    if kind == 'bool':  # 'no' would be true
        fits, wanted = isinstance(value, bool), 'true or false'
    elif kind == 'float':  # dropout
        fits, wanted = type(value) in (int, float) and 0 <= value <= 1, 'a number from 0 to 1'
    elif kind in ('int', 'int | None'):
        least, none = int(default != 0), kind != 'int'  # the number of a joint may be 0
        fits = (type(value) is int and value >= least) or (none and value is None)
        wanted = f'a whole number of at least {least}' + ', or none' * none
    elif 'int' in kind:
        fits = isinstance(value, list | tuple) and all(type(number) is int for number in value)
        wanted = f'whole numbers, for example {",".join(map(str, default))}'
    else:  # the options of another network
        return ''
    return '' if fits else wanted

"""What is trained, on what, and how. There are four named recipes. The command line can replace every value."""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.models.checkpoints import available
from hand_pose_ros.training.augmentation import PRESETS, Augmentation

MAX_SEED = 1 << 22
"""A key of 63 bits holds both the seed and the number of a sample."""


@dataclass(frozen=True)
class Recipe:
    """Everything that decides the result of a training run. The machine (device, processes, folders) does not.

    Raises:
        HandPoseError: the loss, optimiser, schedule or precision does not exist.
    """

    # Network
    network: str = 'deep'
    """A name of `hand_pose_ros.models.ARCHITECTURES`."""
    options: dict[str, Any] = field(default_factory=lambda: {'bottleneck': 30})
    """Arguments of the network, for example options.bottleneck=8, options.bottleneck=none (no prior), options.width=48;
    or of the refiner, for example options.dropout=0."""
    train_prior: bool = True
    """Whether the reconstruction is trained after it was set to the principal components."""
    refiner: str | None = None
    """Train this refiner (std_ref or or_ref) on the estimates of `base`. The base is not trained."""
    base: str | None = None
    """Checkpoint that the refiner corrects, or that a network starts from."""
    first: str | None = None
    """Checkpoint of a hand_dense. It is the first look of two_looks, and is not trained."""

    # Data
    dataset: str = 'synthetic'
    root: str | None = None
    """Folder of a recorded dataset."""
    shard_size: int = 2048
    reuse: int = 4
    """How often a rendered sample is used. It is augmented differently each time."""
    first_shard: int = 0
    """Shards before this one are left out. A refiner always starts after the shards that its base has seen."""
    last_shard: int | None = None
    """Shards from this one on are left out (recorded datasets only)."""
    augmentation: Augmentation = PRESETS['none']

    # Optimisation
    loss: str = 'huber'
    """Loss of the joints: 'huber', 'smooth_l1' or 'squared', see `losses.joint_loss`."""
    knee: float = 0.1
    """Error in cube units from which the loss grows linearly (0.1 is 15 mm in a cube of 0.3 m). 'squared' has none."""
    optimizer: str = 'sgd'
    """'sgd', 'rmsprop', 'adamw' or 'muon'."""
    learning_rate: float = 0.01
    schedule: str = 'constant'
    """How the learning rate falls: 'constant', 'hyperbolic' or 'cosine', see `optimizers.learning_rate`."""
    warmup: float = 0.0
    """Share of the budget during which the learning rate rises linearly from 0."""
    momentum: float = 0.9
    weight_decay: float = 0.001
    batch_size: int = 128
    epochs: int = 100
    samples: int | None = None
    """Budget: the number of samples that are seen. None = `epochs` epochs. In endless data, an epoch is 72,757 samples,
    as many as the NYU training set has. With a budget, an epoch is the budget divided by `epochs`."""
    precision: str = 'float32'
    """'float32', or 'bfloat16' for convolutions and matrix products. This is about 1.5 times as fast on a CPU with the
    instructions (avx512_bf16, amx)."""
    average: float = 0.0
    """The average of the weights is validated and saved. This is its decay per step; 0 = the weights themselves."""
    seed: int = 23455

    # Validation
    val_samples: int = 2048
    """Maximum number of samples. In a recorded dataset, they are spread over the whole split."""
    val_every: int = 65_536
    """Number of training samples between two validations."""

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            if (value := getattr(self, name)) not in choices:
                raise HandPoseError(f"unknown {name} '{value}': choose {', '.join(choices[:-1])} or {choices[-1]}")


EPOCH_OF_ENDLESS_DATA = 72_757
"""Number of samples, see `Recipe.samples`."""

_CHOICES = {'loss': ('huber', 'smooth_l1', 'squared'), 'optimizer': ('sgd', 'rmsprop', 'adamw', 'muon'),
            'schedule': ('constant', 'hyperbolic', 'cosine'), 'precision': ('float32', 'bfloat16')}

_MOST = 1e30
"""More than any number of a recipe needs, and less than infinity."""
_RANGES: dict[str, tuple[float, float]] = {
    'knee': (1e-6, _MOST), 'learning_rate': (1e-9, _MOST), 'seed': (0, MAX_SEED - 1), 'rotation_deg': (0, 180),
    'scale': (1, 2), **dict.fromkeys(('jitter', 'noise'), (0, 0.1)),
    **dict.fromkeys(('first_shard', 'last_shard', 'weight_decay'), (0, _MOST)),
    **dict.fromkeys(('warmup', 'momentum', 'average', 'jitter_tail', 'dropout', 'erase', 'mirror'), (0, 1)),
}
"""Least and greatest value of a number of a recipe or its augmentation. All others must be 1 to `_MOST`."""

RECIPES = {
    # The paper, section 4.1. It gives neither the knee of the Huber loss nor a schedule. Ours are used.
    'paper': Recipe(),
    # What the released code does. It never trains the reconstruction, and has no weight decay if there is dropout.
    'original-code': Recipe(train_prior=False, loss='squared', optimizer='rmsprop', schedule='hyperbolic',
                            momentum=0.0, weight_decay=0.0),
    # A dense network (as AWR, A2J), augmentation of every sample, a loss for which a millimetre always counts, Muon,
    # which needs half the samples of AdamW (docs/training.md), and averaged weights.
    'modern': Recipe(network='hand_dense', augmentation=PRESETS['modern'], loss='smooth_l1', knee=0.01,
                     optimizer='muon', learning_rate=2e-3, schedule='cosine', warmup=0.02, weight_decay=0.01,
                     batch_size=64, samples=2_000_000, precision='bfloat16', average=0.998),
    # For the network that finds hands in whole images. Its objective has its own augmentation.
    'finder': Recipe(network='hand_finder', options={}, dataset='scenes', reuse=10, optimizer='adamw',
                     learning_rate=2e-3, schedule='cosine', warmup=0.02, weight_decay=0.01, batch_size=32,
                     samples=400_000, precision='bfloat16', average=0.998),
}

T = TypeVar('T')


def get_recipe(name: str, overrides: Iterable[str] = ()) -> Recipe:
    """A named recipe with values replaced.

    Args:
        overrides: 'key=value' with a key of `Recipe`, or with dots for a value inside: 'learning_rate=0.003',
            'options.bottleneck=8', 'augmentation.jitter=0.01', 'augmentation=modern', 'base=none'.

    Raises:
        HandPoseError: the recipe or a key does not exist, or a value is of the wrong type or out of range.
    """
    if name not in RECIPES:
        raise HandPoseError(f"unknown recipe '{name}': choose one of {', '.join(RECIPES)}")
    recipe = RECIPES[name]
    for item in overrides:
        key, equals, text = item.partition('=')
        if not equals:
            raise HandPoseError(f'--set {item}: write it as key=value')
        recipe = _replace(recipe, key.split('.'), text, item)
    # So that the run can be resumed from another folder.
    return dataclasses.replace(recipe, base=_absolute(recipe.base), first=_absolute(recipe.first),
                               root=_absolute(recipe.root))


def _absolute(path: str | None) -> str | None:
    """An absolute path, if there is such a file or folder. The names of weights that ship stay as they are."""
    if path is None or path in available() or not (there := Path(path).expanduser()).exists():
        return path
    return str(there.resolve())


def recipe_to_dict(recipe: Recipe) -> dict[str, Any]:
    """For JSON."""
    return dataclasses.asdict(recipe)


def recipe_from_dict(values: dict[str, Any]) -> Recipe:
    """The inverse of `recipe_to_dict`."""
    return Recipe(**{**values, 'augmentation': Augmentation(**values['augmentation'])})


def _replace(target: T, keys: list[str], text: str, item: str) -> T:
    key = keys[0]
    fields = {f.name: str(f.type) for f in dataclasses.fields(target)}  # type: ignore[arg-type]
    if key not in fields:
        raise HandPoseError(f"--set {item}: there is no '{key}'; choose one of {', '.join(fields)}")
    if len(keys) > 1:
        inner = getattr(target, key)
        if isinstance(inner, dict) and len(keys) == 2:
            value: Any = {**inner, keys[1]: _literal(text)}
        elif dataclasses.is_dataclass(inner):
            value = _replace(inner, keys[1:], text, item)
        else:
            raise HandPoseError(f"--set {item}: '{key}' is one value")
    elif fields[key] == 'Augmentation':
        if text not in PRESETS:
            raise HandPoseError(f"--set {item}: choose one of {', '.join(PRESETS)}, or one value: {key}.jitter=0.01")
        value = PRESETS[text]
    else:
        value = _convert(text, fields[key], item, getattr(target, key))
        least, most = _RANGES.get(key, (1, _MOST))
        if type(value) in (int, float) and not least <= value <= most:  # a bool is no number here
            raise HandPoseError(f'--set {item}: must be '
                                + (f'at least {least}' if value < least else f'at most {most}'))
    return dataclasses.replace(target, **{key: value})  # type: ignore[type-var]


def _literal(text: str) -> Any:
    if text.lower() in ('none', 'true', 'false'):
        text = text.capitalize()
    try:
        return ast.literal_eval(text.replace('_', '') if text.replace('_', '').isdigit() else text)
    except (ValueError, SyntaxError):
        return text


def _convert(text: str, kind: str, item: str, now: Any) -> Any:
    """The value of a text for a field of this annotated type, whose value is now another one."""
    value, kinds = _literal(text), [part.split('[')[0] for part in kind.split(' | ')]
    if value is None and 'None' in kinds:
        return None
    if 'str' in kinds:
        return text
    if 'float' in kinds and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if 'int' in kinds and isinstance(value, float) and value.is_integer():  # 2e6
        return int(value)
    if type(value).__name__ in kinds:
        return value
    if 'dict' in kinds:
        raise HandPoseError(f'--set {item}: set each value on its own, for example options.bottleneck=8')
    wanted = 'true or false' if 'bool' in kinds else (
        f"a {'whole ' * ('int' in kinds)}number{', or none' * ('None' in kinds)}, "
        f'for example {1000 if now is None else now}')
    raise HandPoseError(f'--set {item}: give {wanted}')

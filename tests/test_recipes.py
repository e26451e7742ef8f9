"""What recipes promise: any value can be replaced, and what cannot be is refused in one sentence."""

import json

import pytest

from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.training.augmentation import PRESETS
from hand_pose_ros.training.recipes import RECIPES, get_recipe, recipe_from_dict, recipe_to_dict


def test_any_value_of_a_recipe_can_be_replaced():
    recipe = get_recipe('paper', ['samples=2e6', 'options.bottleneck=none', 'augmentation=modern',
                                  'augmentation.jitter=0.01', 'learning_rate=1', 'base=a/b.safetensors',
                                  'train_prior=false'])
    assert (recipe.samples, recipe.options['bottleneck'], recipe.augmentation.jitter) == (2_000_000, None, 0.01)
    assert recipe.augmentation.erase == PRESETS['modern'].erase
    assert (recipe.learning_rate, recipe.base, recipe.train_prior) == (1.0, 'a/b.safetensors', False)
    assert recipe_from_dict(json.loads(json.dumps(recipe_to_dict(recipe)))) == recipe
    assert get_recipe('paper') == RECIPES['paper']


@pytest.mark.parametrize(('override', 'message'), [
    ('lr=1', "no 'lr'"), ('seed', 'key=value'), ('seed=none', 'seed=none: give a whole number, for example 23455$'),
    ('samples=1.5', '--set samples=1.5: give a whole number, or none, for example 1000$'),
    ('learning_rate=fast', 'give a number, for example 0.01$'), ('train_prior=yes', 'give true or false$'),
    ('options=8', 'set each value on its own, for example options.bottleneck=8$'),
    ('samples=-5', '--set samples=-5: must be at least 1'), ('batch_size=0', 'at least 1'), ('seed=-1', 'at least 0'),
    ('seed=20261126', 'at most 4194303'), ('learning_rate=-1', r'learning_rate=-1: must be at least 1e-09'),
    ('learning_rate=1e999', r'1e999: must be at most 1e\+30$'), ('knee=1e999', r'at most 1e\+30'),
    ('knee=0', 'at least 1e-06'), ('weight_decay=-1', 'at least 0'), ('warmup=2', 'at most 1'),
    ('augmentation.scale=0', r'--set augmentation\.scale=0: must be at least 1'),
    ('augmentation.dropout=2', 'at most 1'), ('augmentation.jitter=8', r'at most 0\.1'),
    ('augmentation=strong', 'choose one of'), ('augmentation.strong=1', "no 'strong'"), ('seed.x=1', 'is one value'),
    ('options.bottleneck.x=8', 'is one value'), ('loss=l1', "unknown loss 'l1': choose huber, smooth_l1 or squared"),
    ('optimizer=adam', "unknown optimizer 'adam'"), ('schedule=step', "unknown schedule 'step'"),
    ('precision=float16', "unknown precision 'float16': choose float32 or bfloat16")])
def test_a_wrong_override_is_one_sentence(override, message):
    with pytest.raises(HandPoseError, match=message):
        get_recipe('paper', [override])

"""Kernels of our own for a GPU give what PyTorch gives. Without a GPU, Triton interprets them on the CPU."""

import os

import pytest
import torch
import torch.nn.functional as F
from torch import nn

DEVICE = 'cuda' if torch.cuda.is_available() else 'cpu'
if DEVICE == 'cpu':
    os.environ['TRITON_INTERPRET'] = '1'  # read when Triton is imported
pytest.importorskip('triton', reason='needs Triton, which comes with PyTorch for CUDA')

from hand_pose_ros.models import build  # noqa: E402
from hand_pose_ros.models.refiner import FAR, _framed, cut  # noqa: E402
from hand_pose_ros.runtime import cuda_engine, kernels  # noqa: E402
from hand_pose_ros.runtime.fused import ConvolutionReLU, LinearReLU, fuse  # noqa: E402


@pytest.fixture(autouse=True)
def single_precision():
    torch.manual_seed(0)
    with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        yield


@pytest.mark.parametrize(('inputs', 'filters', 'size', 'pool', 'side', 'groups'), [
    (1, 8, 5, 4, 33, 1), (8, 8, 5, 2, 16, 1), (8, 8, 3, 1, 7, 1), (1, 8, 5, 2, 14, 3), (8, 4, 3, 2, 9, 2)])
@pytest.mark.parametrize('dtype', [torch.float32, torch.float16])
def test_a_convolution_with_its_pooling_and_relu(inputs, filters, size, pool, side, groups, dtype):
    layer = nn.Conv2d(inputs * groups, filters * groups, size, groups=groups).to(memory_format=torch.channels_last)
    x = torch.randn(2, inputs * groups, side, side)
    assert kernels.fits(layer, pool)
    expected = F.relu(F.max_pool2d(layer(x), pool))
    answer = kernels.convolve(x.to(DEVICE, dtype), layer.to(DEVICE, dtype), pool)
    assert answer.dtype == dtype
    torch.testing.assert_close(answer.float().cpu(), expected, rtol=0, atol=1e-5 if dtype == torch.float32 else 5e-3)


@pytest.mark.parametrize('relu', [True, False])
@pytest.mark.parametrize(('inputs', 'outputs'), [(968, 40), (30, 63), (7, 1)])
def test_a_linear_layer(inputs, outputs, relu):
    layer, x = nn.Linear(inputs, outputs), torch.randn(3, inputs)
    expected = F.relu(layer(x)) if relu else layer(x)
    layer = layer.to(DEVICE)
    answer = kernels.linear(x.to(DEVICE), layer.weight, layer.bias, relu).cpu()
    torch.testing.assert_close(answer, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize('refiner', ['std_ref', 'or_ref'])
def test_cuts_around_joints_in_the_image_at_its_border_and_outside(refiner):
    patch = torch.rand(2, 1, 128, 128) * 2 - 1
    patch[:, :, :40] = FAR
    joints = torch.tensor([[[0, 0, 0], [0.31, -0.77, 0.4], [1, 1, -0.2]],
                           [[-1, 0.5, 0], [3, -7, 0], [-0.123, 0.456, 0.9]]], dtype=torch.float32)
    for region in build(refiner).regions:
        image = _framed(patch, region)
        answer = kernels.cut(image.to(DEVICE), joints.to(DEVICE), region).cpu()
        torch.testing.assert_close(answer, cut(image, joints, region), rtol=0, atol=1e-5)


def test_few_hands_are_computed_by_them_and_many_give_the_same():
    layers = nn.Sequential(nn.Sequential(nn.Conv2d(1, 8, 3), nn.MaxPool2d(2), nn.ReLU()), nn.Flatten(),
                           nn.Linear(8 * 9, 5), nn.ReLU(), nn.Linear(5, 2)).to(DEVICE)
    x = torch.randn(kernels.HANDS + 1, 1, 8, 8, device=DEVICE)
    expected = layers(x)
    fuse(layers, kernels)
    assert isinstance(layers[0][0], ConvolutionReLU)
    assert isinstance(layers[2], LinearReLU)
    assert isinstance(layers[4], LinearReLU)
    torch.testing.assert_close(layers(x), expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(layers(x[:2]), expected[:2], rtol=0, atol=1e-5)


def test_a_gpu_does_without_kernels_that_are_interpreted(caplog):
    assert (cuda_engine._own_kernels() is kernels) == ('TRITON_INTERPRET' not in os.environ)
    assert ('TRITON_INTERPRET is set' in caplog.text) == ('TRITON_INTERPRET' in os.environ)

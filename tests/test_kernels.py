"""Kernels of our own for a GPU give what PyTorch gives. Without a GPU, Triton interprets them on the CPU."""

import copy
import os

import pytest
import torch
import torch.nn.functional as F
from torch import nn

DEVICE = 'cuda' if torch.cuda.is_available() else 'cpu'
if DEVICE == 'cpu':
    os.environ['TRITON_INTERPRET'] = '1'  # read when Triton is imported
pytest.importorskip('triton', reason='needs Triton, which comes with PyTorch for CUDA')

from hand_pose_ros.models import build, dense  # noqa: E402
from hand_pose_ros.models.prior import PriorOverVotes  # noqa: E402
from hand_pose_ros.models.refiner import FAR, _framed, cut  # noqa: E402
from hand_pose_ros.runtime import cuda_engine, kernels  # noqa: E402
from hand_pose_ros.runtime.engine import Pipeline  # noqa: E402
from hand_pose_ros.runtime.fused import Convolution, FusedPrior, FusedRefinement, Linear, fuse  # noqa: E402


@pytest.fixture(autouse=True)
def single_precision():
    torch.manual_seed(0)
    with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        yield


def strewn(x: torch.Tensor) -> torch.Tensor:
    """The same on the device, but not side by side in memory, as parts of larger tensors are."""
    return torch.stack([x, torch.full_like(x, torch.nan)], dim=-1).to(DEVICE)[..., 0]


CONVOLUTIONS = [
    # inputs, filters, size, stride, padding, pool, side, groups
    (1, 8, 5, 1, 0, 4, 17, 1), (8, 8, 5, 1, 0, 2, 16, 1), (8, 8, 3, 1, 0, 1, 7, 1), (1, 8, 5, 1, 0, 2, 14, 3),
    (8, 4, 3, 1, 0, 2, 9, 2), (1, 16, 5, 2, 2, 2, 24, 1), (16, 24, 3, 2, 1, 1, 12, 1), (24, 20, 3, 1, 1, 1, 8, 1),
    (20, 42, 1, 1, 0, 1, 6, 1), (16, 32, 1, 2, 0, 1, 8, 1)]


@pytest.mark.parametrize('convolution', CONVOLUTIONS, ids=str)
@pytest.mark.parametrize(('dtype', 'layout'), [
    (torch.float32, torch.contiguous_format), (torch.float16, torch.channels_last)], ids=['single', 'half'])
def test_a_convolution_with_what_follows_it(convolution, dtype, layout):
    inputs, filters, size, stride, padding, pool, side, groups = convolution
    layer = nn.Conv2d(inputs * groups, filters * groups, size, stride, padding, groups=groups)
    x = torch.randn(2, inputs * groups, side, side)
    plain, own = layer(x), copy.deepcopy(layer).to(DEVICE, dtype).to(memory_format=layout)
    assert kernels.fits(own, pool)
    shown = x.to(DEVICE, dtype).to(memory_format=layout)
    tolerance = {'rtol': 0, 'atol': 2e-5 if dtype == torch.float32 else 1e-2}
    answer = kernels.convolve(shown, own, pool)
    assert answer.dtype == dtype
    torch.testing.assert_close(answer.float().cpu(), F.relu(F.max_pool2d(plain, pool)), **tolerance)
    planes = kernels.convolve(shown, own, pool, relu=False, planes=True)
    assert planes.dtype == torch.float32 and planes.is_contiguous()
    torch.testing.assert_close(planes.cpu(), F.max_pool2d(plain, pool), **tolerance)
    if pool == 1 and plain.shape[2] % 2 == 0:
        added = torch.randn(2, filters * groups, plain.shape[2] // 2, plain.shape[2] // 2)
        for more in added, F.interpolate(added, scale_factor=2):
            answer = kernels.convolve(shown, own, added=more.to(DEVICE, dtype))
            expected = F.relu(plain + F.interpolate(added, scale_factor=2))
            torch.testing.assert_close(answer.float().cpu(), expected, **tolerance)


def test_a_convolution_of_other_kinds_is_left_to_pytorch():
    for options in ({'stride': (1, 2)}, {'padding': (1, 0)}, {'padding': 'same'}, {'dilation': 2}, {'bias': False},
                    {'padding': 1, 'padding_mode': 'reflect'}):
        assert not kernels.fits(nn.Conv2d(8, 8, 3, **options), 1)
    assert not kernels.fits(nn.Conv2d(8, 8, (3, 1)), 1)
    assert not kernels.fits(nn.Conv2d(8, 8, 3), 3)


@pytest.mark.parametrize(('slope', 'activation'), [(1, nn.Identity()), (0, nn.ReLU()), (0.1, nn.LeakyReLU(0.1))])
@pytest.mark.parametrize(('inputs', 'outputs'), [(968, 40), (30, 63), (7, 1)])
def test_a_linear_layer_with_what_follows_it(inputs, outputs, slope, activation):
    layer, x, added = nn.Linear(inputs, outputs), torch.randn(3, inputs), torch.randn(3, outputs)
    expected = activation(layer(x))
    layer = layer.to(DEVICE)
    for more in None, strewn(added):
        answer = kernels.linear(strewn(x), layer.weight, layer.bias, slope, more).cpu()
        torch.testing.assert_close(answer, expected if more is None else expected + added, rtol=0, atol=1e-5)


@pytest.mark.parametrize('refiner', ['std_ref', 'or_ref'])
def test_cuts_around_joints_in_the_image_at_its_border_and_outside(refiner):
    patch = torch.rand(2, 1, 128, 128) * 2 - 1
    patch[:, :, :40] = FAR
    joints = torch.tensor([[[0, 0, 0], [0.31, -0.77, 0.4], [1, 1, -0.2], [1.1, 0.3, 0.1], [3, 0.2, 0]],
                           [[-1, 0.5, 0], [3, -7, 0], [-0.123, 0.456, 0.9], [0.3, 1.1, 0.1], [0.2, 3, 0]]])
    network = build(refiner)
    fuse(network, kernels)
    assert network.cut is kernels.cut
    for region in network.regions:
        image = _framed(patch, region)
        answer = kernels.cut(strewn(image), strewn(joints), region).cpu()
        torch.testing.assert_close(answer, cut(image, joints, region), rtol=0, atol=1e-5)


def patches() -> torch.Tensor:
    """A wall of noise, a hand that ends at a border, a single pixel, and nothing."""
    shown = torch.ones(4, 1, 128, 128)
    shown[0] = torch.rand(128, 128) * 1.9 - 1
    shown[1, :, 30:90, :50] = torch.rand(60, 50) - 0.5
    shown[2, :, 64, 3] = -0.25
    return shown


def test_cells_that_see_something_and_those_that_do_not():
    shown = patches()
    for answer, expected in zip(kernels.cells(strewn(shown)), dense.cells(shown), strict=True):
        torch.testing.assert_close(answer.cpu(), expected, rtol=0, atol=1e-6)


def test_joints_from_votes():
    positions, seen = dense.cells(patches())
    maps, others = torch.randn(4, 5 * 4, 32, 32).to(DEVICE), torch.randn(4, 7, 32, 32).to(DEVICE) / 3
    parts = maps[:, :15].unflatten(1, (5, 3)), others[:, 2:]  # five joints
    directions, closeness = (part.cpu() for part in parts)
    answer = kernels.decode(positions.to(DEVICE), seen.to(DEVICE), *parts)
    for told, expected in zip(answer, dense.decode(positions, seen, directions, closeness), strict=True):
        torch.testing.assert_close(told.cpu(), expected, rtol=0, atol=1e-5)


def test_the_second_look_sees_what_it_would():
    network, shown = build('two_looks', width=4, root=3, knuckles=(5, 9, 14)), patches()
    joints = 0.5 * torch.randn(4, 21, 3)
    joints[1] = 0  # no direction
    joints[2] += torch.tensor([1.3, 0, -0.4])  # looks beyond the patch
    size = torch.tensor([0.0, -0.7, 0.2, 2.0])
    (middle, turn, scale), seen = kernels.seen(network, *map(strewn, (shown, joints, size)))
    view, expected = network.seen(shown, joints, size)
    for told, part in zip((middle, turn, scale), view, strict=True):
        torch.testing.assert_close(told.cpu(), part, rtol=0, atol=1e-6)
    torch.testing.assert_close(seen.cpu(), expected, rtol=0, atol=1e-5)


def test_the_refinement_of_joints_in_the_maps_at_their_border_and_outside():
    refinement = dense.JointRefinement(3, local=9 + 4, whole=6)
    nn.init.normal_(refinement.output.weight, std=0.1)
    for norm in refinement.norm, refinement.norm_whole:
        nn.init.normal_(norm.running_mean)
        nn.init.uniform_(norm.running_var, 0.5, 2)
        nn.init.normal_(norm.weight)
        nn.init.normal_(norm.bias)
    joints = torch.tensor([[[0, 0, 0], [0.31, -0.77, 0.4], [1, 1, -0.2]],
                           [[-1, 0.5, 0], [3, -7, 0], [-0.123, 0.999, 0.9]]])
    local = torch.randn(2, 9, 16, 16), torch.randn(2, 4, 16, 16).to(memory_format=torch.channels_last)
    told = joints, joints + 0.1, torch.randn(2, 3), local, torch.randn(2, 6)
    expected = refinement.eval()(*told)
    owner = nn.ModuleDict({'refinement': refinement})
    fuse(owner, kernels)
    owner.to(DEVICE)
    told = *map(strewn, told[:3]), [x.to(DEVICE) for x in local], told[4].to(DEVICE)
    assert isinstance(owner['refinement'], FusedRefinement)
    torch.testing.assert_close(owner['refinement'](*told).cpu(), expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(owner['refinement'].plain(*told).cpu(), expected, rtol=0, atol=1e-5)


def test_few_hands_are_computed_by_them_and_many_give_the_same():
    other = nn.Conv2d(12, 12, (1, 3))  # which they do not compute
    layers = nn.Sequential(nn.Sequential(nn.Conv2d(1, 12, 3), nn.MaxPool2d(2), nn.ReLU(), other, nn.ReLU(),
                                         nn.Conv2d(12, 12, 1), nn.MaxPool2d(1)), nn.Flatten(),
                           nn.Linear(12 * 3, 5), nn.ReLU(), nn.Linear(5, 2)).to(DEVICE)
    x = torch.randn(kernels.HANDS + 1, 1, 8, 8, device=DEVICE)
    expected = layers(x)
    fuse(layers, kernels)
    assert [type(layer) for layer in (layers[0][0], layers[2], layers[4])] == [Convolution, Linear, Linear]
    assert not kernels.gains(layers[0][0].convolution, len(x))
    torch.testing.assert_close(layers(x), expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(layers(x[:2]), expected[:2], rtol=0, atol=1e-5)


@pytest.mark.parametrize('hands', [2, 17])
def test_the_prior_over_votes(hands):
    prior, joints, confidence = PriorOverVotes(4, 6), torch.randn(hands, 4, 3), torch.randn(hands, 4)
    nn.init.normal_(prior.output.weight, std=0.1)
    expected, owner = prior(joints, confidence), nn.ModuleDict({'prior': prior})
    fuse(owner, kernels)
    for dtype, tolerance in (torch.float32, 1e-5), (torch.float16, 1e-2):
        told = owner.to(DEVICE, dtype)['prior'](joints.to(DEVICE), confidence.to(DEVICE))
        torch.testing.assert_close(told.float().cpu(), expected, rtol=0, atol=tolerance)
    assert isinstance(owner['prior'], FusedPrior)


@pytest.mark.parametrize('hands', [2, 17])
def test_few_filters_are_computed_by_them_for_any_number_of_hands(hands):
    layer = nn.Conv2d(1, 8, 3).to(DEVICE)
    x = torch.randn(hands, 1, 12, 12, device=DEVICE)
    assert kernels.gains(layer, hands)
    torch.testing.assert_close(kernels.convolve(x, layer, 2), F.relu(F.max_pool2d(layer(x), 2)), rtol=0, atol=1e-5)


def test_a_dense_network_of_two_looks_is_the_same():
    network = build('two_looks', joints=4, knuckles=[1, 3], width=8, bottleneck=8, refined=True,
                    first={'width': 4, 'bottleneck': 8}).eval()
    for each in network.first, network.second:
        each.maps.weight.mul_(30)
    shown = patches()[1:2]
    pipeline = Pipeline(copy.deepcopy(network))
    fuse(pipeline, kernels)
    for each in pipeline.network.first, pipeline.network.second:
        assert (each.cells, each.decode) == (kernels.cells, kernels.decode)
    assert pipeline.network.seen.func is kernels.seen
    for answer, expected in zip(pipeline.to(DEVICE)(shown.to(DEVICE)), Pipeline(network)(shown), strict=True):
        torch.testing.assert_close(answer.cpu(), expected, rtol=0, atol=1e-4)


def test_what_is_copied_is_the_same():
    source, target = torch.randn(3, 1, 40, 40), torch.zeros(3, 1, 40, 40, pin_memory=DEVICE == 'cuda')
    kernels.copy(strewn(source), target)
    if DEVICE == 'cuda':
        torch.cuda.synchronize()
    assert torch.equal(source, target)


def test_a_gpu_does_without_kernels_that_are_interpreted(caplog):
    assert (cuda_engine._own_kernels() is kernels) == ('TRITON_INTERPRET' not in os.environ)
    assert ('TRITON_INTERPRET is set' in caplog.text) == ('TRITON_INTERPRET' in os.environ)

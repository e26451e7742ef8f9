"""The networks have the published shapes, the prior is a principal component analysis, and each refiner and decoder
does what its formula says."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import nn

from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.models import ARCHITECTURES, build
from hand_pose_ros.models.dense import JointRefinement, cells, decode, encode
from hand_pose_ros.models.prior import fit_prior
from hand_pose_ros.models.refiner import Refiner
from hand_pose_ros.models.two_looks import View
from hand_pose_ros.skeleton import HAND21, SKELETONS

pytestmark = pytest.mark.usefixtures('one_thread')

POSE_NETWORKS = ('shallow', 'deep', 'deep_prior', 'multi_scale', 'resnet', 'hand_dense')
REFINERS = ('std_ref', 'or_ref')


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def parameters(network: nn.Module) -> int:
    return sum(p.numel() for p in network.parameters())


def hand_patches(count: int) -> torch.Tensor:
    """Patches with a sloping disc, like a palm, before the background."""
    y, x = torch.meshgrid(*[torch.linspace(-1, 1, 128)] * 2, indexing='ij')
    centers, slopes = torch.rand(count, 2, 1, 1) * 0.4 - 0.2, torch.rand(count, 2, 1, 1) - 0.5
    inside = (x - centers[:, 0]) ** 2 + (y - centers[:, 1]) ** 2 < 0.4
    depth = slopes[:, 0] * x + slopes[:, 1] * y + 0.02 * torch.rand(count, 128, 128)
    return torch.where(inside, depth, torch.ones(())).clamp(-1, 1)[:, None]


# Deep, with and without the prior: (joints, direct, prior), counted from the layers of the original network.
@pytest.mark.parametrize(('joints', 'direct', 'prior'), [
    (14, 2_087_306, 2_076_308), (16, 2_093_456, 2_076_494), (21, 2_108_831, 2_076_959)])
def test_deep_has_the_original_number_of_parameters(joints, direct, prior):
    assert parameters(build('deep', joints=joints)) == direct
    assert parameters(build('deep', joints=joints, bottleneck=30)) == prior
    assert parameters(build('deep_prior', joints=joints)) == prior


def test_the_other_networks_have_the_original_number_of_parameters():
    assert parameters(build('center_refiner')) == 3_567_651
    # The same branches with 63 outputs instead of 3.
    assert parameters(build('multi_scale')) == 3_567_651 + 60 * 1025
    as_built, as_meant = (parameters(build('resnet', joints=14, last_stride=stride)) for stride in (1, 2))
    assert as_built == pytest.approx(18.71e6, abs=5e3)
    assert as_meant == pytest.approx(6.2e6, abs=5e4)


def test_layer_shapes_of_deep_and_multi_scale():
    def shapes(module: nn.Module, patch: torch.Tensor) -> list[tuple[int, ...]]:
        found: list[tuple[int, ...]] = []
        hooks = [m.register_forward_hook(lambda _, __, out: found.append(tuple(out.shape[1:])))
                 for m in module.modules() if isinstance(m, (nn.ReLU, nn.Linear))]
        module(patch)
        for hook in hooks:
            hook.remove()
        return found

    patch = torch.zeros(1, 1, 128, 128)
    assert shapes(build('deep', bottleneck=30).features, patch) == [(8, 31, 31), (8, 13, 13), (8, 11, 11)]
    assert shapes(build('multi_scale').features, patch) == [
        (8, 31, 31), (8, 13, 13), (8, 11, 11), (8, 30, 30), (8, 13, 13), (8, 11, 11), (8, 14, 14), (8, 10, 10),
        (8, 8, 8)]
    assert shapes(build('deep', bottleneck=30).head, torch.zeros(1, 968)) == [
        (1024,), (1024,), (1024,), (1024,), (30,), (63,)]


def test_initialisation_follows_the_original():
    network = build('deep_prior')
    first, third = network.features[0][0], network.features[2][0]
    assert first.weight.std().item() == pytest.approx((2 / 25) ** 0.5, rel=0.2)
    assert third.weight.std().item() == pytest.approx((2 / 72) ** 0.5, rel=0.1)
    assert network.head.hidden[0].weight.std().item() == pytest.approx(0.01, rel=0.01)
    limit = (6 / (1024 + 30)) ** 0.5
    assert 0.99 * limit < network.head.output.weight.abs().max().item() <= limit
    assert all((p == 0).all() for name, p in network.named_parameters() if name.endswith('bias'))


@pytest.mark.parametrize('architecture', ['shallow', 'deep', 'multi_scale'])
def test_hidden_units_are_dropped_while_a_network_learns_as_often_as_is_said(architecture):
    network, patches = build(architecture, dropout=0.0), hand_patches(1)
    assert torch.equal(network(patches), network(patches))
    network = build(architecture, dropout=0.6)
    dropped = [part for part in network.modules() if isinstance(part, nn.Dropout)]
    assert dropped and all(part.p == 0.6 for part in dropped)
    assert not torch.equal(network(patches), network(patches))


@pytest.mark.parametrize('architecture', POSE_NETWORKS)
@pytest.mark.parametrize('joints', [14, 21])
def test_every_pose_network_maps_patches_to_joints_and_learns(architecture, joints):
    network = build(architecture, joints=joints)
    for norm in (part for part in network.modules() if isinstance(part, nn.BatchNorm2d)):
        nn.init.ones_(norm.weight)  # residual blocks start as the identity, and then hear nothing
    patches = hand_patches(4)
    answer = network(patches)
    assert answer.shape == (4, joints, 3)
    assert answer.isfinite().all()
    answer.square().sum().backward()
    moving = [p.grad is not None and bool(p.grad.abs().sum() > 0) for p in network.parameters()]
    # hand_dense has a summary (confidence, side, ...) that the joints do not depend on.
    assert sum(moving) >= len(moving) - (2 if architecture == 'hand_dense' else 0)


def test_shallow_starts_deaf_to_the_background():
    """Or Adam kills its hidden units in the first steps: after 300,000 samples it answered the mean pose."""
    network = build('shallow')
    assert network.features(torch.ones(1, 1, 128, 128)).abs().max() < 1e-5
    assert network.features(hand_patches(1)).abs().max() > 0.01


def test_the_prior_behind_the_votes_starts_as_a_projection_and_learns_what_is_not_seen():
    rng = np.random.default_rng(0)
    poses = rng.normal(size=(2000, 30)) @ rng.normal(size=(30, 63)) * 0.05
    prior = fit_prior(poses, 30)
    network = build('hand_dense', width=8, bottleneck=30).eval()
    network.set_prior(prior.mean, prior.components)
    answer = network.forward_full(hand_patches(3))
    expected = prior.reconstruct(prior.project(answer['votes'].detach().reshape(3, -1).numpy()))
    np.testing.assert_allclose(answer['joints'].detach().reshape(3, -1), expected, atol=1e-5)

    # One joint of each pose is lost, and the head is told which: it follows from the others.
    truth = torch.tensor(poses, dtype=torch.float32).view(-1, 21, 3)
    lost = torch.randint(21, (2000,))
    confidence = torch.full((2000, 21), 4.0)
    confidence[torch.arange(2000), lost] = -4.0
    votes = truth.clone()
    votes[torch.arange(2000), lost] = 0.0
    head = network.head
    optimizer = torch.optim.Adam(head.parameters(), 1e-3)
    for _ in range(300):
        optimizer.zero_grad()
        F.mse_loss(head(votes[:1500], confidence[:1500]), truth[:1500]).backward()
        optimizer.step()

    def error(joints: torch.Tensor) -> float:
        return float((joints - truth)[1500:][torch.arange(500), lost[1500:]].norm(dim=-1).mean())
    projected = torch.tensor(prior.reconstruct(prior.project(votes.flatten(1).numpy()))).view_as(truth)
    assert error(head(votes, confidence).detach()) < 0.7 * error(projected) < 0.7 * error(votes)


@pytest.mark.parametrize('architecture', ['shallow', 'deep', 'multi_scale', 'resnet'])
@pytest.mark.parametrize('bottleneck', [8, 30])
def test_the_reconstruction_is_the_inverse_transform_of_the_prior_and_is_trained(architecture, bottleneck):
    poses = np.random.default_rng(0).normal(size=(200, 63)) * 0.3
    prior = fit_prior(poses, bottleneck)
    network = build(architecture, bottleneck=bottleneck).eval()
    network.set_prior(prior.mean, prior.components)
    coefficients = torch.randn(5, bottleneck)
    expected = prior.reconstruct(coefficients.numpy())
    np.testing.assert_allclose(network.head.reconstruction(coefficients).detach(), expected, atol=1e-5)
    # What the network says lies in the space of the prior.
    pose = network(hand_patches(2)).detach().reshape(2, -1).numpy()
    np.testing.assert_allclose(prior.reconstruct(prior.project(pose)), pose, atol=1e-4)
    network(hand_patches(2)).sum().backward()
    assert network.head.reconstruction.weight.grad.abs().sum() > 0


def test_the_prior_equals_a_singular_value_decomposition():
    rng = np.random.default_rng(1)
    poses = rng.normal(size=(500, 12)) @ rng.normal(size=(12, 63)) + rng.normal(size=63)
    prior = fit_prior(poses.reshape(500, 21, 3), 8)
    _, singular, rows = np.linalg.svd(poses - poses.mean(0), full_matrices=False)
    # An eigenvector is known up to its sign.
    np.testing.assert_allclose(np.abs(np.sum(prior.components * rows[:8], axis=1)), 1, atol=1e-9)
    np.testing.assert_allclose(prior.explained_variance_ratio, singular[:8] ** 2 / np.sum(singular ** 2), atol=1e-12)
    np.testing.assert_allclose(prior.components @ prior.components.T, np.eye(8), atol=1e-12)
    expected = (poses - poses.mean(0)) @ rows[:8].T @ rows[:8] + poses.mean(0)
    np.testing.assert_allclose(prior.reconstruct(prior.project(poses)), expected, atol=1e-9)
    still = fit_prior(np.ones((40, 63)))  # of a hand that never moves
    assert (still.explained_variance_ratio == 0).all() and np.isfinite(still.components).all()
    assert (fit_prior(poses, 63).explained_variance_ratio >= 0).all()
    assert (np.abs(prior.components).max(1) == prior.components.max(1)).all()  # and that one is chosen
    # Twelve degrees of freedom need twelve components and no more.
    full = fit_prior(poses, 12)
    np.testing.assert_allclose(full.reconstruct(full.project(poses)), poses, atol=1e-9)


def test_mistakes_are_named():
    with pytest.raises(HandPoseError, match=r'choose one of .*deep'):
        build('deeper')
    for name, wrong, wanted in (
            ('blocks', 2, 'whole numbers, for example 1,1,1,1'), ('blocks', (1, 'x', 1, 1), 'whole numbers'),
            ('width', 'x', 'a whole number of at least 1$'), ('width', -8, 'a whole number of at least 1'),
            ('refined', 'no', 'true or false'), ('bottleneck', 2.5, 'a whole number of at least 1, or none')):
        for architecture in ('hand_dense', 'two_looks'):
            with pytest.raises(HandPoseError, match=f'^{architecture} cannot have {name}=.*: give {wanted}'):
                build(architecture, **{name: wrong})
    for architecture in (*POSE_NETWORKS, 'two_looks'):
        with pytest.raises(HandPoseError, match=f'^{architecture} cannot have bottleneck=0: give .* 1, or none'):
            build(architecture, bottleneck=0)
    with pytest.raises(HandPoseError, match=r'dropout=2: give a number from 0 to 1'):
        build('deep', dropout=2)
    with pytest.raises(HandPoseError, match='width 1: give at least 2'):
        build('hand_finder', width=1)
    for channels in [], [32], [1, 2, 3]:
        with pytest.raises(HandPoseError, match='give two numbers or more, each at least 4'):
            build('resnet', channels=channels)
    with pytest.raises(HandPoseError, match=r'hidden \[96, 0\]: give numbers of at least 1'):
        build('or_ref', hidden=[96, 0])
    with pytest.raises(HandPoseError, match="'resnet' cannot be made with"):
        build('resnet', last_stride=100)
    with pytest.raises(HandPoseError, match='does not take depth: it takes joints'):
        build('deep', depth=3)
    with pytest.raises(HandPoseError, match='without a bottleneck'):
        build('deep').set_prior(np.zeros(63), np.zeros((30, 63)))
    with pytest.raises(HandPoseError, match='does not fit a bottleneck of 30 and 21 joints'):
        build('deep_prior').set_prior(np.zeros(42), np.zeros((30, 42)))
    with pytest.raises(HandPoseError, match=r'mean \(42,\) does not fit'):
        build('deep_prior').set_prior(np.zeros(42), np.zeros((30, 63)))
    with pytest.raises(HandPoseError, match=r'30 components need .* options\.bottleneck=N'):
        fit_prior(np.zeros((10, 63)), 30)
    with pytest.raises(HandPoseError, match='30 components need'):
        fit_prior(np.zeros((100, 12)), 30)
    with pytest.raises(HandPoseError, match='not finite'):
        fit_prior(np.full((100, 63), np.nan), 30)


def test_build_remembers_everything_that_made_the_network():
    network = build('deep_prior', joints=14)
    assert network.architecture == 'deep_prior'
    assert network.config == {'joints': 14, 'bottleneck': 30, 'dropout': 0.3}
    assert {*POSE_NETWORKS, *REFINERS, 'two_looks', 'center_refiner', 'hand_finder'} == set(ARCHITECTURES)


def test_the_center_refiner_sees_fine_the_middle_and_coarsely_the_rest():
    network = build('center_refiner').eval()
    patches = hand_patches(3)
    palm = network(patches)
    assert palm.shape == (3, 3)
    middle = slice(60, 68)
    windows = [(slice(0, 8), slice(0, 8), 1), (middle, middle, 3)]
    for first, behind, coarser in ((32, 96, 1), (48, 80, 2)):  # at the borders of the crops, inside and outside
        for inside, outside in ((slice(first, first + 4), slice(first - 4, first)),
                                (slice(behind - 4, behind), slice(behind, behind + 4))):
            windows += [(inside, middle, coarser + 1), (middle, inside, coarser + 1), (outside, middle, coarser),
                        (middle, outside, coarser)]
    with torch.no_grad():
        branches = network.features.branches
        for rows, columns, seeing in windows:
            changed = patches.clone()
            changed[..., rows, columns] = -1
            seen = [number < seeing for number in range(3)]
            for branch, before, after, sees in zip(branches, network.features.views(patches),
                                                   network.features.views(changed), seen, strict=True):
                assert (branch(before) != branch(after)).any().item() is sees


def test_multi_scale_sees_the_patch_at_full_half_and_quarter_resolution():
    patches = hand_patches(2)
    whole, half, quarter = build('multi_scale').features.views(patches)
    assert torch.equal(whole, patches)
    for view, size in ((half, 2), (quarter, 4)):
        cells = patches.unflatten(3, (-1, size)).unflatten(2, (-1, size))
        torch.testing.assert_close(view, cells.mean((3, 5)))


def awake(architecture: str) -> Refiner:
    """A refiner whose offsets are as large as a trained one's: fresh weights move nothing."""
    refiner = build(architecture).eval().requires_grad_(False)
    refiner.weights[-1].mul_(15)
    return refiner


@pytest.mark.parametrize('architecture', REFINERS)
def test_all_joints_at_once_equal_joint_by_joint(architecture):
    refiner = awake(architecture)
    patches = hand_patches(3)
    estimates = torch.rand(3, 21, 3) * 2.4 - 1.2  # some outside of the patch
    together = refiner(patches, estimates)
    assert (together - estimates).abs().max() > 0.05
    alone = torch.stack([
        torch.cat([refiner.for_joint(j)(patches[i:i + 1], estimates[i:i + 1, j:j + 1])[0] for j in range(21)])
        for i in range(3)])
    torch.testing.assert_close(together, alone, atol=1e-5, rtol=0)


@pytest.mark.parametrize('architecture', REFINERS)
def test_one_joint_equals_plain_convolutions_over_a_sampled_window(architecture):
    """The formula, written out once more with other means: grid_sample instead of indices, plain layers instead of
    grouped ones."""
    refiner, joint = awake(architecture), 7
    patch = hand_patches(1)
    estimate = torch.tensor([[[0.11, -0.23, 0.05]]]).repeat(1, 21, 1)

    marked = torch.where(patch < 1, patch, torch.full_like(patch, 1e4))
    features = []
    for region, branch in zip(refiner.regions, refiner.branches, strict=True):
        reach = region.width / 128
        nearest = -F.max_pool2d(-marked, region.shrink)
        depth = ((nearest - estimate[0, joint, 2]) / reach).clamp(-1, 1)
        cells = region.width // region.shrink
        line = ((torch.arange(cells) + 0.5) / cells * 2 - 1) * reach
        grid = torch.stack([line.expand(cells, -1) + estimate[0, joint, 0],
                            line[:, None].expand(-1, cells) + estimate[0, joint, 1]], dim=-1)
        x = F.grid_sample(depth, grid[None], mode='bilinear', padding_mode='border', align_corners=False)
        for module in branch:
            if isinstance(module, nn.Conv2d):
                count = module.out_channels // 21
                own = slice(joint * count, (joint + 1) * count)
                x = F.conv2d(x, module.weight[own], module.bias[own])
            else:
                x = module(x)
        features.append(x.flatten())
    x = torch.cat(features)
    for i, (weight, bias) in enumerate(zip(refiner.weights, refiner.biases, strict=True)):
        x = x @ weight[joint] + bias[joint, 0]
        x = F.relu(x) if i < len(refiner.weights) - 1 else x
    expected = estimate[0, joint] + x / 2  # offsets are in units of the largest cube, half of the hand's
    torch.testing.assert_close(refiner(patch, estimate, iterations=1)[0, joint], expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize('architecture', REFINERS)
def test_the_refiner_iterates_from_its_own_answer(architecture):
    refiner, patches, estimates = awake(architecture), hand_patches(2), torch.rand(2, 21, 3) - 0.5
    once = refiner(patches, estimates, iterations=1)
    torch.testing.assert_close(refiner(patches, estimates), refiner(patches, once, iterations=1))
    torch.testing.assert_close(refiner(patches, estimates, iterations=0), estimates)


@pytest.mark.parametrize('architecture', REFINERS)
def test_the_refiner_follows_the_hand(architecture):
    """What it adds depends on the surroundings of the joint alone: shift hand and estimate, and it stays the same."""
    refiner, patch = awake(architecture), hand_patches(1)
    moved = torch.roll(patch, (4, -6), dims=(2, 3))  # the disc is far from the border
    moved = torch.where(moved < 1, moved + 0.1, moved)
    estimate = torch.rand(1, 21, 3) * 0.4 - 0.2
    shift = torch.tensor([-6 / 64, 4 / 64, 0.1])
    before = refiner(patch, estimate, iterations=1) - estimate
    after = refiner(moved, estimate + shift, iterations=1) - estimate - shift
    torch.testing.assert_close(before, after, atol=1e-4, rtol=0)


@pytest.mark.parametrize('architecture', REFINERS)
def test_each_joint_of_the_refiner_learns_from_its_own_error_only(architecture):
    refiner = build(architecture)
    patches, estimates = hand_patches(2), torch.zeros(2, 21, 3).requires_grad_()
    answer = refiner(patches, estimates)
    assert (answer != refiner(patches, estimates)).any()  # dropout
    answer[:, 3].square().sum().backward()
    assert estimates.grad is None  # where it looks is taken as given
    learns = refiner.weights[-1].grad.abs().sum(dim=(1, 2)) > 0
    assert learns.tolist() == [j == 3 for j in range(21)]


def test_orref_fits_in_twelve_megabytes_of_half_precision():
    assert 2 * parameters(build('or_ref')) <= 12e6


def test_an_untrained_refiner_moves_nothing_far():
    for architecture in REFINERS:
        estimates = torch.rand(2, 21, 3) - 0.5
        answer = build(architecture).eval()(hand_patches(2), estimates)
        assert (answer - estimates).abs().max() < 0.05


def test_dense_maps_and_joints_are_inverse_to_each_other():
    patches = hand_patches(3)
    positions, seen = cells(patches)
    # Joints as they are: a little under the visible surface.
    rows, cols = torch.randint(12, 20, (2, 3, 21))
    joints = positions[torch.arange(3)[:, None], :, rows, cols] + torch.tensor([0.02, -0.01, 0.1])
    directions, closeness = encode(positions, joints)
    again, agreement = decode(positions, seen, directions, closeness)
    torch.testing.assert_close(again, joints, atol=1e-4, rtol=0)
    assert (agreement > 0.8).all()
    near = closeness > 0
    assert near.any() and not near.all()
    torch.testing.assert_close(directions.norm(dim=2), near.float())
    # What sees nothing has no vote, whatever it says; but where nothing is seen, all have one.
    blind = seen[:, None] == 0
    unheard = decode(positions, seen, directions.where(~blind, 1), closeness.where(~blind[:, 0], 1))
    torch.testing.assert_close(unheard, (again, agreement))
    nothing = decode(positions, 0 * seen, directions, closeness)
    torch.testing.assert_close(nothing, decode(positions, 0 * seen + 1, directions, closeness), atol=1e-2, rtol=0)


def test_dense_cells_are_in_cube_units():
    patch = torch.ones(1, 1, 128, 128)
    patch[0, 0, 8:12, 120:124] = torch.tensor([-0.5, -0.5, 1, 1])  # half of the cell reads nothing
    positions, seen = cells(patch)
    # Columns 120 to 123 have their centre at (121.5 + 0.5) / 64 - 1.
    torch.testing.assert_close(positions[0, :, 2, 30], torch.tensor([122 / 64 - 1, 10 / 64 - 1, -0.5]))
    assert seen.sum() == 1
    assert (positions[0, 2] == 1).sum() == 1023


def test_a_refinement_starts_as_the_identity_and_learns_from_what_is_seen_at_the_joints():
    truth = torch.rand(400, 4, 3) - 0.5
    joints = truth + 0.1 * torch.randn_like(truth)
    # Maps like those a network would make: where a joint may be, they tell how deep the hand is there.
    local = torch.zeros(400, 2, 32, 32)
    rows, cols = ((truth[..., k] + 1) * 16 for k in (1, 0))
    line = torch.arange(32) + 0.5
    for joint in range(4):
        near = (-((line[:, None] - rows[:, joint, None, None]) ** 2 + (line - cols[:, joint, None, None]) ** 2) / 32)
        local[:, 0] += near.exp()
        local[:, 1] += near.exp() * truth[:, joint, 2, None, None]
    told = joints, joints, torch.zeros(400, 4), local.split(1, dim=1), torch.randn(400, 3)
    refinement = JointRefinement(4, local=2, whole=3)
    torch.testing.assert_close(refinement(*told), joints)
    optimizer = torch.optim.AdamW(refinement.parameters(), 1.4e-3)
    for _ in range(100):
        optimizer.zero_grad()
        F.smooth_l1_loss(refinement(*told), truth, beta=0.01).backward()
        optimizer.step()
    deeper = (refinement.eval()(*told) - truth).detach()[..., 2].abs().mean()
    assert deeper < 0.5 * (joints - truth)[..., 2].abs().mean()


def test_where_a_refinement_reads_is_no_output_and_never_outside():
    refinement = JointRefinement(2, local=3, whole=4).eval()
    nn.init.normal_(refinement.output.weight)
    nn.init.zeros_(refinement.each[:, 3:])  # what is told, and not read
    joints = torch.tensor([[[0.8, -0.6, 0.1], [1.0, -1.0, 0.0]]], requires_grad=True)
    local = torch.randn(1, 3, 32, 32, requires_grad=True)
    rest = torch.zeros(1, 2, 3), torch.zeros(1, 2), [local], torch.randn(1, 4)
    moved = refinement(joints, *rest) - joints
    moved.sum().backward()
    assert moved.abs().max() > 0 and joints.grad.abs().max() == 0
    # Column 28.3 and row 5.9, and the corner at the upper right.
    rows, columns = local.grad[0].abs().sum(0).nonzero().T.tolist()
    assert list(zip(rows, columns, strict=True)) == [(0, 31), (5, 28), (5, 29), (6, 28), (6, 29)]
    further = joints.detach() * torch.tensor([[[1.0], [3.0]]])
    torch.testing.assert_close(refinement(further, *rest) - further, moved)


def test_training_in_half_precision_halves_neither_votes_nor_joints():
    network = build('hand_dense', width=8, bottleneck=8).eval()
    with torch.autocast('cpu', torch.bfloat16):
        answer = network.forward_full(hand_patches(2))
    votes, _ = decode(*(answer[name] for name in ('positions', 'seen', 'directions', 'closeness')))
    torch.testing.assert_close(answer['votes'], votes, atol=1e-6, rtol=0)
    torch.testing.assert_close(answer['joints'], network.head(votes, answer['confidence']), atol=1e-6, rtol=0)


def test_joints_do_not_bend_the_confidence():
    network = build('hand_dense', width=8, bottleneck=8, refined=True)
    for layer in (network.head.output, network.refinement.output):
        nn.init.normal_(layer.weight)
    network(hand_patches(2)).sum().backward()
    assert network.summary.weight.grad is None and network.head.hidden.weight.grad.abs().sum() > 0


def test_dense_network_says_everything_and_survives_an_empty_patch():
    network = build('hand_dense').eval()
    patches = torch.cat([hand_patches(2), torch.ones(1, 1, 128, 128)])
    answer = network.forward_full(patches)
    assert {name: tuple(answer[name].shape) for name in network.outputs} == {
        'joints': (3, 21, 3), 'confidence': (3, 21), 'hand': (3,), 'side': (3,), 'size': (3,)}
    assert all(tensor.isfinite().all() for tensor in answer.values())
    torch.testing.assert_close(network(patches), answer['joints'])
    assert parameters(build('hand_dense', width=16)) < parameters(network) / 3


def a_hand(count: int = 6) -> tuple[torch.Tensor, torch.Tensor]:
    """Joints like those of hands that are turned any way, and what is told of their size."""
    rng = np.random.default_rng(3)
    upright = rng.normal(0, 0.12, (count, 21, 3))
    upright[:, list(HAND21.knuckles), 1] -= 0.3
    angle = torch.from_numpy(rng.uniform(-np.pi, np.pi, count))
    turn = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], 1).view(-1, 2, 2)
    joints = torch.from_numpy(upright + rng.normal(0, 0.1, (count, 1, 3)))
    joints[..., :2] = joints[..., :2] @ turn
    return joints.float(), torch.from_numpy(rng.normal(0, 0.1, count)).float()


def test_the_second_look_sees_every_hand_upright_in_the_middle_and_equally_large():
    joints, size = a_hand()
    network = build('two_looks', width=4)
    view = network.upright(joints, size)
    seen = view.into(joints)
    assert seen.mean(1).abs().max() < 0.02  # a pixel, to which views are rounded
    up = seen[:, list(HAND21.knuckles)].mean(1) - seen[:, 0]
    assert (up[:, 1] < 0).all() and (up[:, 0] / up[:, 1]).abs().max() < 0.02
    width, seen_width = ((points - points.mean(1, keepdim=True)).square().sum((1, 2)).sqrt()
                         for points in (joints, seen))
    torch.testing.assert_close(seen_width * size.exp(), width / 0.95, rtol=0.01, atol=0)
    torch.testing.assert_close(view.back(seen), joints, atol=1e-6, rtol=0)
    with torch.autocast('cpu', torch.bfloat16):  # the truth of training is not rounded
        assert torch.equal(view.into(joints), seen)
    # What is told of the size counts up to a factor of 1.5.
    for told, limit in ((9.0, 0.4), (-9.0, -0.4)):
        assert network.upright(joints, torch.full((6,), told)).scale.div(0.95).log().sub(limit).abs().max() < 0.01
    # One that points at the camera, and one of which nothing is known, are seen somehow.
    assert all(part.isfinite().all() for part in network.upright(torch.zeros(1, 21, 3), torch.zeros(1)))


def test_readings_are_seen_where_points_are_seen():
    view = build('two_looks', width=4).upright(*a_hand())
    rng = np.random.default_rng(0)
    for i in range(6):
        row, column = rng.integers(30, 98, 2)
        patch = torch.ones(6, 1, 128, 128)
        patch[i, 0, row - 2:row + 3, column - 2:column + 3] = 0.25
        point = torch.tensor([(column + 0.5) / 64 - 1, (row + 0.5) / 64 - 1, 0.25]).float().repeat(6, 1, 1)
        x, y, z = view.into(point)[i, 0].tolist()
        seen = view.patch(patch)
        rows, columns = (seen[i, 0] < 1).nonzero(as_tuple=True)
        assert abs(z) < 1 and abs(columns.float().mean() - (x + 1) * 64 + 0.5) < 0.6
        assert abs(rows.float().mean() - (y + 1) * 64 + 0.5) < 0.6
        torch.testing.assert_close(seen[i, 0, rows, columns], torch.full((len(rows),), z))
        assert (seen[torch.arange(6) != i] == 1).all()
    # To the pixel: upside down, all are there.
    noise = torch.rand(1, 1, 128, 128)
    assert torch.equal(View(torch.zeros(1, 3), -torch.eye(2)[None], torch.ones(1)).patch(noise), noise.flip(2, 3))
    # What lies beyond the patch is background, and so is what lies behind the back of the view.
    aside = View(torch.tensor([[0.9, 0.0, 0.0]]), torch.eye(2)[None], torch.ones(1))
    assert (aside.patch(torch.zeros(1, 1, 128, 128))[..., 72:] == 1).all()
    near = View(torch.tensor([[0.0, 0.0, -0.5]]), torch.eye(2)[None], torch.full((1,), 0.5))
    assert (near.patch(torch.full((1, 1, 128, 128), 0.2)) == 1).all()


def test_a_turn_of_the_patch_is_not_seen_by_the_second_look():
    patch, (joints, size) = hand_patches(6), a_hand()
    network = build('two_looks', width=4)
    turned = torch.stack([-joints[..., 1], joints[..., 0], joints[..., 2]], dim=-1)
    view, other = network.upright(joints, size), network.upright(turned, size)
    seen, same = view.patch(patch), other.patch(patch.rot90(-1, (2, 3)))
    assert (seen < 1).float().mean() > 0.1 and (seen != same).float().mean() < 1e-3
    torch.testing.assert_close(view.into(joints), other.into(turned), atol=1e-5, rtol=0)


def test_two_looks_say_everything_of_the_patch_as_it_is():
    network = build('two_looks', width=8, bottleneck=8).eval()
    patches = torch.cat([hand_patches(2), torch.ones(1, 1, 128, 128)])
    answer, (view, shown) = network.forward_full(patches), network.look(patches)
    first, seen = network.first.forward_full(patches), network.second.forward_full(shown)
    torch.testing.assert_close(view, network.upright(first['joints'], first['size']))
    assert torch.equal(shown, view.patch(patches)) and not torch.equal(shown, patches)
    assert answer.keys() == set(network.outputs)
    torch.testing.assert_close(view.into(answer['joints']), seen['joints'], atol=1e-5, rtol=0)
    torch.testing.assert_close(answer['size'], seen['size'] + torch.log(view.scale))
    torch.testing.assert_close(network(patches), answer['joints'])
    answer['joints'].sum().backward()
    assert {name.split('.')[0] for name, p in network.named_parameters() if p.grad is not None} == {'second'}
    assert not network.train().first.training and network.second.training
    assert not any(weight.requires_grad for weight in network.first.parameters())
    assert build('two_looks', width=8, first={'width': 4}).first.width == 4


def test_a_hand_without_these_joints_has_no_upright():
    with pytest.raises(HandPoseError, match=r'root 0 and knuckles \[5, 9, 13, 17\] are not all among 14 joints'):
        build('two_looks', joints=14)
    with pytest.raises(HandPoseError, match=r'knuckles \[5, 5, 9\]: give each joint once'):  # engines would differ
        build('two_looks', knuckles=(5, 5, 9))


@pytest.mark.parametrize('skeleton', SKELETONS.values(), ids=SKELETONS)
def test_every_skeleton_has_four_knuckles_and_a_root(skeleton):
    assert [skeleton.fingers[joint] for joint in sorted(skeleton.knuckles, key=lambda j: skeleton.fingers[j])] == [
        'index', 'middle', 'pinky', 'ring']
    assert skeleton.parents[skeleton.root] == -1 and skeleton.fingers[skeleton.root] == 'palm'
    assert skeleton.middle_finger[-1] == skeleton.root and len(skeleton.middle_finger) >= 3
    build('two_looks', joints=len(skeleton), root=skeleton.root, knuckles=skeleton.knuckles, width=4)

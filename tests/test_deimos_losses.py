"""Losses: their gradients against autograd in float64, and the kernel's against them."""

import copy
import math

import pytest
import torch
from torch.distributions import Independent, Normal

from deimos.nn.losses import Surrogate, ValueLoss, cross_entropy, log_prob, mean_squared_error
from deimos.nn.mlps import MLPs, gradients
from deimos.nn.networks import Actor, mlp

ACTIONS, ROWS = 3, 1000


def transitions(rows=ROWS, seed=0):
    """The data of a surrogate, and behind them value before and target, float64; some rows of weight 0."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    action, mean = draw(ACTIONS, rows), 0.3 * draw(ACTIONS, rows)
    std = torch.full((ACTIONS, 1), 0.8, dtype=torch.float64)
    density = log_prob((action - mean) / std, std)
    weight = (draw(rows) > -1.0).double() / rows
    return torch.cat([action, mean, torch.stack([density, draw(rows), weight, draw(rows), draw(rows)])]).unsqueeze(0)


def surrogate(data, clip=0.2):
    return Surrogate(data[:, : 2 * ACTIONS + 3], clip)


def value_loss(data, clip=0.2):
    return ValueLoss(data[:, -3:], clip)


def textbook_surrogate(data, mean, std):
    """PPO's objective as its paper has it, by torch's own distributions."""
    action, _, (old, advantage, weight) = data[0, : 2 * ACTIONS + 3].split([ACTIONS, ACTIONS, 3])
    ratio = (Independent(Normal(mean, std), 1).log_prob(action.t()) - old).exp()
    objective = torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage)
    return -(weight * objective).sum()


def test_surrogate_is_the_papers():
    """Loss, gradients by mean and deviation, and the squares of how far the mean moved are autograd's."""
    data = transitions()
    generator = torch.Generator().manual_seed(1)
    mean = 0.3 * torch.randn(1, ROWS, ACTIONS, generator=generator, dtype=torch.float64)
    mean, std = mean.requires_grad_(), torch.tensor([[0.7, 0.9, 1.1]], dtype=torch.float64, requires_grad=True)
    expected = textbook_surrogate(data, mean[0], std[0])
    by_mean, by_std = torch.autograd.grad(expected, [mean, std])
    sums, found_mean, found_std = surrogate(data)(mean.detach(), std.detach())
    torch.testing.assert_close(sums[0, 0], expected.detach())
    torch.testing.assert_close(found_mean, by_mean)
    torch.testing.assert_close(found_std, by_std)
    moved = ((mean[0].detach() - data[0, ACTIONS : 2 * ACTIONS].t()).square() * data[0, -3].unsqueeze(1)).sum(0)
    torch.testing.assert_close(sums[0, 1:], moved)
    assert 0.1 < (found_mean == 0).all(2).float().mean() < 0.9  # some are clipped


@pytest.mark.parametrize("clip", [0.2, math.inf])
def test_value_loss_is_the_larger_of_two(clip):
    """Loss and gradient are autograd's of the larger of the plain and the clipped squared error."""
    data = transitions()
    weight, old, target = data[0, -3:]
    value = torch.randn(1, ROWS, 1, dtype=torch.float64).requires_grad_()
    plain = (value[0, :, 0] - target).square()
    clipped = (old + (value[0, :, 0] - old).clamp(-clip, clip) - target).square()
    expected = (weight * torch.maximum(plain, clipped)).sum()
    sums, slopes, _ = value_loss(data, clip)(value.detach(), value.detach()[:, :0, 0])
    torch.testing.assert_close(sums[0, 0], expected.detach())
    torch.testing.assert_close(slopes, torch.autograd.grad(expected, value)[0])


def test_rounding_does_not_decide_within_the_clip():
    """A value that has not moved follows its target, though the clipped error may round above the plain one."""
    data = torch.rand(1, 3, 1000) + 0.1
    _, slopes, _ = ValueLoss(data, 0.2)(data[:, 1].unsqueeze(2), torch.zeros(1, 0))
    assert (slopes != 0).float().mean() > 0.99


@pytest.mark.parametrize("name", ["cross_entropy", "mean_squared_error"])
def test_other_losses_are_torchs(name):
    """Values and gradients are autograd's of torch's own functions."""
    target, weight = (torch.rand(50) < 0.3).double(), torch.rand(50, dtype=torch.float64)
    y = torch.randn(1, 50, 1, dtype=torch.float64).requires_grad_()
    if name == "cross_entropy":
        loss = cross_entropy(target, weight)
        expected = torch.nn.functional.binary_cross_entropy_with_logits(y[0, :, 0], target, weight, reduction="sum")
    else:
        loss, expected = mean_squared_error(target.unsqueeze(1)), torch.nn.functional.mse_loss(y[0, :, 0], target)
    sums, slopes, _ = loss(y.detach(), torch.zeros(1, 0))
    torch.testing.assert_close(sums[0, 0], expected.detach())
    torch.testing.assert_close(slopes, torch.autograd.grad(expected, y)[0])


def learners():
    generator = torch.Generator().manual_seed(3)
    actor = MLPs([Actor(8, (32, 16), ACTIONS, "elu", 0.7, generator)])
    return actor, MLPs([mlp(8, (32, 16), 1, "elu", generator)])


@pytest.mark.parametrize("rows", [1, 50, ROWS])
@pytest.mark.parametrize("clip", [0.2, math.inf])
def test_the_kernels_are_these(rows, clip):
    """Sums and gradients of the kernel are those of the functions here in float64, up to float32's rounding."""
    data, x = transitions(rows, seed=rows), torch.randn(rows, 8, generator=torch.Generator().manual_seed(rows))
    nets = learners()
    losses = surrogate(data.float(), clip), value_loss(data.float(), clip)
    found = gradients(*((own, x, loss) for own, loss in zip(nets, losses, strict=True)))
    for own, loss, sums, kind in zip(nets, losses, found, (surrogate, value_loss), strict=True):
        assert own._kernel is not None
        module = own.modules[0].double()
        y = module(x.double()).unsqueeze(0)
        free = module.std.detach().unsqueeze(0) if isinstance(loss, Surrogate) else torch.zeros(1, 0)
        expected, slopes, by_free = kind(data.float().double(), clip)(y.detach(), free)
        torch.testing.assert_close(sums.double(), expected, rtol=1e-4, atol=1e-6)
        grads = torch.autograd.grad((y * slopes).sum(), [p for name, p in module.named_parameters() if name != "std"])
        grads = torch.cat([by_free.flatten(), *(grad.flatten() for grad in grads)])
        torch.testing.assert_close(own.grad[0].double(), grads, rtol=1e-3, atol=1e-5 * float(grads.abs().max()))


@pytest.mark.parametrize("rows", [97, 100, 143, 144])
def test_what_fills_a_block_does_not_overflow(rows):
    """With a narrow policy, whose density overflows a little away from its mean, gradients are torch's, and finite."""
    actor = Actor(6, (64, 64), 12, "relu", 1e-4)
    x, noise = torch.randn(rows, 6), torch.randn(12, rows)
    data = torch.zeros(1, 27, rows)
    data[0, :12] = 1e-4 * noise
    data[0, 24] = log_prob(noise, torch.full((12, 1), 1e-4))
    data[0, 25:] = torch.stack([torch.randn(rows), torch.full((rows,), 1 / rows)])
    found = []
    for kernel in (True, False):
        own = MLPs([copy.deepcopy(actor)])
        own._kernel = own._kernel if kernel else None
        found.append((own.gradient(x, Surrogate(data, 0.2)), own.grad))
    for mine, torchs in zip(*found, strict=True):
        assert torchs.isfinite().all()
        torch.testing.assert_close(mine, torchs, rtol=1e-3, atol=1e-6 + 1e-5 * float(torchs.abs().max()))


@pytest.mark.parametrize("name", ["log_prob", "advantage", "weight", "old", "target"])
def test_nan_breaks_the_loss(name):
    """In the kernel as in torch, NaN in the data shows in the loss or in the gradient."""
    data = transitions().float()
    data[0, 2 * ACTIONS + ["log_prob", "advantage", "weight", "old", "target"].index(name), 17] = torch.nan
    x, broken = torch.randn(ROWS, 8), []
    for kernel in (True, False):
        nets = learners()
        for own in nets:
            own._kernel = own._kernel if kernel else None
        sums = gradients((nets[0], x, surrogate(data)), (nets[1], x, value_loss(data)))
        broken.append([bool(torch.cat([s, own.grad], dim=1).isnan().any()) for s, own in zip(sums, nets, strict=True)])
    assert broken[0] == broken[1]
    assert any(broken[0])


def test_rows_of_no_weight_teach_nothing():
    """Where all weights are 0 so are sums and gradients."""
    data = transitions().float()
    data[0, -3] = 0.0
    actor, critic = learners()
    sums = gradients((actor, torch.randn(ROWS, 8), surrogate(data)), (critic, torch.randn(ROWS, 8), value_loss(data)))
    assert not any(tensor.any() for tensor in (*sums, actor.grad, critic.grad))


def test_parts_of_a_loss_are_those_of_its_rows():
    """Two parts add up to the whole, in the kernel too, which reads them where they lie."""
    data, x = transitions().float(), torch.randn(ROWS, 8)
    actor, critic = learners()
    totals = []
    for parts in ((slice(0, ROWS),), (slice(0, 333), slice(333, ROWS)), (slice(0, ROWS, 2), slice(1, ROWS, 2))):
        total = [0.0, 0.0]
        for rows in parts:
            gradients((actor, x[rows], surrogate(data)[rows]), (critic, x[rows], value_loss(data)[rows]))
            total = [total[0] + actor.grad, total[1] + critic.grad]
        totals.append(total)
    for whole, *added in zip(*totals, strict=True):
        for total in added:
            torch.testing.assert_close(total, whole, rtol=1e-4, atol=1e-6)

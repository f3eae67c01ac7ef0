"""Scores of candidates by one kernel instead of products: no result changes."""

import sys

import pytest
import torch

from deimos.nn import fusion
from deimos.nn.fused import fuse
from deimos.nn.fusion import fused_scores
from deimos.nn.networks import ManyCandidates, Whitening, mlp


@pytest.mark.parametrize("outputs", [1, 16])
def test_fused_scores_are_the_networks(torch_device, outputs):
    """One kernel gives what products give, for more and fewer decisions, other candidates, weights and whitening."""
    torch.manual_seed(0)
    net = mlp(9, (64,), outputs, "relu", torch.default_generator).to(torch_device)
    mean, factor = torch.randn(3, device=torch_device), torch.ones(3, device=torch_device)
    whitening = Whitening(mean, factor, bound=1.0) if outputs > 1 else None
    fused, by_products = fuse(net, 3, whitening=whitening), ManyCandidates(net, 3)
    kept = []
    for rows, count in ((20, 100), (3, 100), (50, 100), (20, 1), (20, 100)):
        context = torch.randn(rows, 6, device=torch_device)
        candidates = torch.randn(rows, count, 3, device=torch_device)
        seen = ((candidates - mean) * factor).clamp(-1, 1) if whitening else candidates
        expected = by_products(context, seen)
        expected = expected.square().mean(2) if whitening else expected.squeeze(2)
        found = fused(context, candidates)
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
        kept.append((found, found.clone()))
        with torch.no_grad():
            for parameter in net.parameters():
                parameter += 0.01 * torch.randn_like(parameter)
        factor *= 0.9
    assert all(torch.equal(scores, copied) for scores, copied in kept), "a later call overwrote earlier scores"


def test_fused_scores_need_warp(monkeypatch):
    """Without Warp no network has a kernel, and nothing is imported to find that out."""
    net = mlp(9, (64,), 1, "relu", torch.default_generator)
    assert fused_scores(net, 3) is not None
    monkeypatch.setattr(fusion, "find_spec", lambda name: None)
    monkeypatch.delitem(sys.modules, "deimos.nn.fused")
    assert fused_scores(net, 3) is None
    assert "deimos.nn.fused" not in sys.modules


def test_fused_scores_take_any_view():
    """Candidates that do not lie end to end are read as what they are."""
    torch.manual_seed(0)
    net = mlp(9, (64,), 1, "relu", torch.default_generator)
    candidates = torch.randn(100, 20, 3).transpose(0, 1)
    context = torch.randn(20, 6)
    expected = ManyCandidates(net, 3)(context, candidates).squeeze(2)
    torch.testing.assert_close(fuse(net, 3)(context, candidates), expected, rtol=1e-4, atol=1e-5)


def test_fused_scores_outlive_an_inference():
    """What was first asked for in inference mode, as rsl_rl's rollouts are, is asked for outside it later."""
    fused, arguments = (
        fuse(mlp(9, (64,), 1, "relu", torch.default_generator), 3),
        (torch.randn(20, 6), torch.randn(20, 30, 3)),
    )
    with torch.inference_mode():
        first = fused(*arguments)
    assert torch.equal(fused(*arguments), first)


def test_fused_scores_check_their_shapes():
    """No decision has no score; contexts and candidates that do not fit raise ``ValueError`` before any launch."""
    fused = fuse(mlp(9, (64,), 1, "relu", torch.default_generator), 3)
    assert fused(torch.zeros(0, 6), torch.zeros(0, 100, 3)).shape == (0, 100)
    for context, candidates in (((4, 6), (2, 100, 3)), ((4, 5), (4, 100, 3)), ((4, 6), (4, 100, 2))):
        with pytest.raises(ValueError, match=r"must have the shapes \(B, 6\) and \(B, N, 3\)"):
            fused(torch.zeros(*context), torch.zeros(*candidates))


@pytest.mark.parametrize(
    ("hidden", "outputs", "activation", "goal_dim", "whitened"),
    [
        ((64, 64), 1, "relu", 3, False),
        ((64,), 1, "tanh", 3, False),
        ((64,), 2, "relu", 3, False),
        ((64,), 1, "relu", 7, False),
        ((64,), 6, "relu", 3, True),
        ((64,), 16, "relu", 4, True),
    ],
)
def test_what_no_kernel_does_is_left_to_products(hidden, outputs, activation, goal_dim, whitened):
    """Other networks than the kernel's get none."""
    whitening = Whitening(torch.zeros(goal_dim), torch.ones(goal_dim), 5.0) if whitened else None
    assert fuse(mlp(9, hidden, outputs, activation), goal_dim, whitening=whitening) is None
